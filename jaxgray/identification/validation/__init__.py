"""Whether a model and its record go together.

residuals       fits, whiteness, correlation with inputs
structure_test  whether another linear model explains more
free_modes      that other model: free residues at free poles
reach           whether the inputs move every output
"""
