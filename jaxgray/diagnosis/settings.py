"""Every threshold that decides what a diagnosis says: value, meaning and unit, source.

Read as `settings.NAME`, so that a benchmark can move one of them for the whole package. What is only numerics (steps of
an iteration, points of a grid, tolerances of a solver) stands where it is used. Sources: *theory* where a text gives
the value, *benchmark* where `benchmarks/hidden_effects.py` or `frames.py` calibrated it, *convention* otherwise.
"""

# Evidence of a candidate

MIN_DELTA_BIC = 10.0
"""ΔBIC from which a candidate passes the gate, a refit counts, another end of a refit is the better one, and
noise at the forces is said: "very strong" evidence, short of which look-alikes are one class (Kass & Raftery, J. Amer.
Statist. Assoc. 90 (1995) 773-795)."""

CLEAR_DELTA_BIC = 100.0
"""ΔBIC from which something is there, whatever the noise (benchmark)."""

SIGNIFICANCE = 0.01
"""Probability of a false alarm: of the gate over all families (Holm), and of further parameters that pay by chance
(theory)."""

LOOK_ALIKE_SIGNIFICANCE = 0.1
"""The same for laws that stand for one another: a parameter that may well be there leaves both of them (benchmark)."""

MIN_STANDARD_ERRORS = 4.0
"""|β|/se from which an amplitude counts (benchmark)."""

MIN_STANDARD_ERRORS_IF_CLEAR = 2.0
"""|β|/se that is enough where ΔBIC is beyond `CLEAR_DELTA_BIC` (benchmark)."""

MIN_EXPLAINED_SHARE = 0.1
"""Least share of what is left above the noise that a finding must explain (convention)."""

MIN_RESIDUAL_SHARE = 0.02
"""Share of what is left that the best effect must explain for "unexplained" to be said when no refit holds
(benchmark)."""

LARGE_RESIDUAL_SHARE = 0.3
"""Share of what is left from which a candidate is refitted though noise at the forces could explain it (benchmark)."""

# Records that the linear model does not follow

OUT_OF_PHASE = 0.2
"""Share of the variance of an output from which what a free run leaves of it says that it does not follow the record
(convention)."""

WINDOW_SHARE = 0.1
"""Share of the squared residual that linear models of the ends of a record may leave where a parameter that changes
over time is looked for in its windows, and that such a change may leave there (convention)."""

# Classes

CLASS_DELTA_BIC = 6.0
"""Difference of BIC within which two refits count as one class: short of "strong" (Kass & Raftery 1995)."""

EQUAL_DELTA_BIC = 2.0
"""Difference of BIC within which two laws explain as much: "not worth more than a bare mention" (Kass & Raftery
1995)."""

MAX_CRITERION_GAP = 100.0
"""Distance in criterion from the best first refit beyond which a candidate is not refined further; its refit is given
up at twice this (benchmark)."""

# Held-out data

HELD_OUT_RISK = 0.01
"""Probability that a gain which is none passes for a sure one: of the first candidate judged on held-out data, the k-th
part of it of the k-th since the last sure finding (convention)."""

MAX_LOSS = 100.0
"""Loss [%] in the 95 % interval of the gain on other records from which a finding is not credible: there it may double
the error of the linear model (convention)."""

# What is noise

MIN_EXCESS = 1.05
"""Error over the noise floor from which more than noise is left (convention)."""

MIN_HELD_OUT_EXCESS = 1.5
"""The same on held-out data, whatever the data of the fit show (benchmark)."""

STAND_IN_EXCESS = 1.2
"""Excess on held-out data from which a law that leaves only noise on the data of its fit may stand in for another
(benchmark)."""

WHITE_INNOVATIONS = 0.9
"""Innovations over the residual, root mean squares, below which the residual is not white (benchmark)."""

MISFIT_PROBABILITY = 1e-8
"""Probability of the structure test from which a linear model that nothing was added to has not explained all
(benchmark)."""

MISFIT_SHARE = 25.0
"""Share of the residual [%] that another linear model must explain where noise is coloured, which passes for a little
more of dynamics; an effect of 1.15 times the noise explains 25 % (theory). Twice that where noise enters at the
forces."""

LARGE_RESIDUAL = 50.0
"""Share of an output's motion [%] from which what a model leaves, unless white, is more than noise usually is
(convention)."""

MAX_FORCE_NOISE = 1.0
"""Noise at the forces relative to the recorded ones beyond which coloured noise is the better word (convention)."""

# Routes: free run, force equation, static gain

USABLE_FIT = 80.0
"""Fit [%] of the linear free run from which it is of use, and from which no other start of it is tried (benchmark)."""

POOR_FIT = 30.0
"""Fit [%] of the linear free run below which it is of no use by itself (benchmark)."""

USELESS_FIT = 10.0
"""The same where the force equation finds nothing (benchmark)."""

UNDETERMINED_MASS = 0.5
"""Relative standard error of a mass from which it is not determined (convention)."""

NOISE_MULTIPLE = 10.0
"""Error in units of the measurement's noise from which a model is far from explaining the record (benchmark)."""

MUCH_NEARER = 0.5
"""Error of one model relative to another's below which it is the better one whatever else speaks for the other
(convention)."""

SIMPLER_SHARE = 0.8
"""Share of what the best law explains that a simpler one must explain to be preferred in the force equation
(benchmark)."""

SINGLE_LINE_SHARE = 1e-3
"""Share of an input's power off one line below which it is a single sine (convention)."""

STATIC_RESIDUAL = 0.5
"""What a straight line in the inputs leaves, relative to the motion, below which motion follows them statically
(convention)."""

PUSH_SIZE = 8.0
"""How far an unmeasured force stands out of what is left elsewhere, in robust standard deviations (benchmark)."""

PUSH_GAP = 1.5
"""Ratio of accelerations from which the larger stand apart from the rest (benchmark)."""

MAX_PUSH_SHARE = 0.05
"""Share of the samples with such forces above which it is the model that is wrong (convention)."""

# Refits

RESTART_RESIDUAL = 0.95
"""Residual of a refit for the free run, relative to that of the first, below which it is taken (convention)."""

MATCHED_FORCE = 0.2
"""What a law's force may leave of another's, beside a spring's and a damper's, relative to what these leave, for its
refit to begin there (benchmark)."""

MAX_STEP_ERROR = 0.1
"""Error of the integration steps, relative to the residual, that is never left (convention)."""

OUTLYING_RESIDUAL = 4.0
"""Residual, in root mean squares of the samples away from reversals, from which a sample of an accelerometer beside a
reversal is undecided (theory: one normal sample in 16 000)."""

SLOW_VELOCITY = 0.1
"""Velocity, relative to its root mean square, below which a reversal may lie within an integration step
(convention)."""

MAX_UNDECIDED_SHARE = 0.02
"""Share of the samples above which they are not left out as undecided: then it is the model that is wrong
(convention)."""

MAX_START_POWER = 0.5
"""Share of the sum of squares of the linear model's free run that a law found by the force equation may leave for its
refit to go on (convention)."""

# Search

MAX_PROVISIONAL = 2
"""Findings that may be in the model provisionally at a time (convention)."""

MAX_FREE_ROUNDS = 3
"""Rounds that only rule something out, and do not count (convention)."""

# Data

MIN_SAMPLES = 20
"""Samples of a record for validation, and samples whose past is known, without which nothing can be told
(convention)."""

MAX_OFFSET = 3.0
"""Difference of the zeros of two records, in units of the largest motion about its mean in any record, from which it is
no effect of the dynamics (convention)."""

BEYOND_RANGE = 0.25
"""Share of the range of the fit that held-out data may move beyond it (convention)."""

MAX_OUTLIER_SHARE = 0.01
"""Share of the samples above which spikes are the residual's own (convention)."""

# The next experiment

SEPARATION = 9.0
"""Separation d² that tells two models apart in white noise: three standard deviations (theory)."""

MIN_SEPARATION_RATIO = 1.5
"""Separation relative to that of the record from which an experiment is worth proposing (convention)."""
