"""What is wrong with the records themselves, or too little in them.

sample_size        whether a record holds enough
output_offsets     output zeros that differ between records
residual_outliers  outliers that only a fit shows
extrapolation      held-out data beyond the range of the fit
record_findings    clipping, quantisation, noise at the forces, feedback
"""
