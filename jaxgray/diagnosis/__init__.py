"""What a simulation gets wrong: measured records in, one immutable `Diagnosis` out.

diagnose           the pipeline
own_simulator      the user's own simulator as the model on trial
simulated_outputs  a model in the place of a simulation of which only the outputs are known
stamped            records with rows at times of their own
routing            which likelihood can judge a record
conclusions        the result: tables, budget, curves, next experiment
search             which effects are in the model, by free runs: propose, refit, accept, drop
starts             where a refit can begin, besides the score test
estimation         refits of one structure
equation_error     the force equation as likelihood
static_gain        the quasi-static gain as likelihood
selection          forward selection for both, whose refits cost little
data_checks        what is wrong with the records themselves
screening          the score test: which effects the residual shows
noise              noise models, smoothing, noise floor
model              what is estimated, on what, and its simulation
acceptance         the one rule by which a candidate becomes a finding
result             the diagnosis as one immutable result
words              sentences and titles for readers
findings           what a diagnosis consists of
settings           every threshold that decides what a diagnosis says

Imports go down this list.
"""
