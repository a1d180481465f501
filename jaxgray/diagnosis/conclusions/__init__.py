"""From the end of a search to the result.

assembly        findings, summaries, parameter shifts and budget of the free-run search
candidates      table of what was tested and refused
explainable     share of a residual that any smooth force explains
equation_error  result of the force equation
static_gain     result of a static gain
missing_force   the force that the model lacks, over displacement and velocity
spectra         spectra of output, errors and noise
physics         whether a model could be a machine: energy of its laws, passivity of its matrices
next_experiment the record that would part what this one does not
"""
