"""The experiment that tells each effect from what looks like it: one sentence an effect, for its page."""

TOLD_APART = {
    "cubic_stiffness": "Large amplitudes at low frequency: a cubic spring goes on stiffening, a stop or a sine does "
    "not follow the third power.",
    "quadratic_stiffness": "The same amplitude to both sides of rest: a quadratic spring shifts the mean, a cubic "
    "one does not.",
    "dead_zone_stiffness": "Slow motion through the middle of the travel at several amplitudes: inside a dead zone "
    "nothing resists.",
    "end_stop": "Amplitudes below and above the expected gap: below it a stop does nothing at all.",
    "bilinear_stiffness": "Slow motion about zero with different loads to each side: the slope changes at zero "
    "alone, whatever the amplitude.",
    "sine_stiffness": "Travel over more than one period: only a sine comes back.",
    "constant_force": "Another mounting direction, or sensors zeroed at rest without load: a force moves with "
    "gravity, an offset with the sensor.",
    "position_dependent_stiffness": "Records at several held values of the scheduling channel.",
    "coulomb_friction": "Very slow motion and fast motion at the same amplitude: dry friction stays the same, "
    "viscous friction grows.",
    "stribeck_friction": "Motion that dwells at low speed: below the Stribeck velocity friction rises again.",
    "asymmetric_friction": "Constant speeds forward and backward: the two losses differ.",
    "quadratic_drag": "Two amplitudes at one frequency: the damping ratio grows with the amplitude, that of dry "
    "friction falls.",
    "position_dependent_friction": "The same small motion at several positions along the path.",
    "load_friction": "Another payload: friction of the load grows with it, Coulomb friction stays.",
    "fractional_damping": "Excitation over two decades of frequency: damping between spring and damper at all of them.",
    "dahl_friction": "Motion much smaller than the play of the contact: before it slides, dry friction with an "
    "elastic contact is a spring.",
    "bouc_wen_hysteresis": "Quasi-static loops at several amplitudes: their shape changes with amplitude in a way "
    "of its own for each law.",
    "maxwell_slip_hysteresis": "Quasi-static loops within loops: a sum of stops remembers every reversal.",
    "gyroscopic_coupling": "Another speed of rotation: the coupling is proportional to it and takes no energy.",
    "circulatory_coupling": "Another flow or feedback gain: the coupling feeds or drains energy around a loop.",
    "input_delay": "Fast steps: a delay shifts them whole, a lag rounds them, another hold looks like half a sample.",
    "actuator_lag": "A multisine up to half the sampling frequency: a lag loses amplitude, a delay does not.",
    "intersample_hold": "A faster sampling rate: the difference between holds shrinks with the square of the step.",
    "band_limited_input": "A faster sampling rate: the difference between holds shrinks with the square of the step.",
    "input_saturation": "Inputs below and above the limit: below it nothing changes.",
    "speed_force_limit": "The largest command against a stop and in free motion: a saturation gives the same force in "
    "both.",
    "input_dead_zone": "Small inputs: inside the zone nothing moves, and friction of the machine is not felt by the "
    "force that is measured.",
    "input_quadratic": "The input with its sign reversed: an even law does not change sign.",
    "input_position_gain": "The same input at several positions.",
    "play_hysteresis": "Slow loops of the input at several amplitudes: play has flat ends, creep depends on time.",
    "actuator_creep": "A step held for long: creep goes on after the step, play does not.",
    "sensor_offset": "The sensor zeroed at a known position: an offset goes, a constant force stays.",
    "sensor_drift": "A second record later: a drift belongs to the clock of one record.",
    "sensor_delay": "A second sensor with its own path on the same coordinate.",
    "sensor_lag": "Motion near the upper end of the band: a lag loses amplitude, a delay does not.",
    "sensor_crosstalk": "One channel at rest while the other moves.",
    "sensor_nonlinearity": "Known displacements read off a gauge at several positions: a spring does not bend the "
    "reading.",
    "clock_scale": "One event recorded by both clocks at the beginning and at the end.",
    "dropped_samples": "Sample counters in both data streams.",
    "unmodelled_mode": "One more sensor where the mode is expected.",
    "stiffness_drift": "A second record later: what wears goes on, what warms up comes back.",
    "stiffness_step": "A second record: after damage the new stiffness is there from the start.",
    "mass_step": "A second record with the same load: a mass that was lost stays lost.",
    "periodic_disturbance": "A record with the inputs at zero: the disturbance is all that moves.",
    "force_step": "A second record: a step belongs to the clock of one record.",
}
