"""The score test: which effects, places and shapes the residual shows to first order.

scales          sizes of the record at every place
features        first-order response of every effect, place and shape
projections     products of responses off the model's sensitivities
spectral_lines  strongest lines of a residual
linearization   the model linearised about its free run, or about smoothed motion
flexible_force  a black-box force that opens the gate and is never named
score_test      scores, Holm's test, surrogate calibration
shortlist       which candidates are refitted
"""
