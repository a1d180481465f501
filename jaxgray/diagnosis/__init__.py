"""What a simulation gets wrong: measured records in, one immutable `Diagnosis` out.

diagnose     the pipeline
simulated_outputs  what stands in for a simulation of which only the outputs are known
routing      which likelihood can judge a record
conclusions  the result: tables, budget, curves, next experiment
search       which effects are in the model, by free runs: propose, refit, accept, drop
starts       where a refit can begin, besides the score test
estimation   refits of one structure
selection    forward selection where refits cost little
equation_error, static_gain  the likelihoods that it serves: force equation, quasi-static gain
data_checks  what is wrong with the records themselves
screening    the score test: which effects the residual shows
noise        noise models, smoothing, noise floor
model        what is estimated, on what, and its simulation
acceptance   the one rule by which a candidate becomes a finding
result, findings, words, settings

Imports go down this list.
"""
