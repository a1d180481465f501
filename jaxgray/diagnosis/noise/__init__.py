"""What the residual of a right model looks like.

whitening          white, autoregressive and process noise as one whitening filter
smoother           states smoothed with the whole record
floor              noise floor that does not depend on a model
effective_samples  how many independent samples a correlated residual is worth
"""
