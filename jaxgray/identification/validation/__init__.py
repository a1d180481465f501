"""Whether a model and its record go together.

residuals       fits, whiteness, correlation with inputs
structure_test  whether another linear model explains more
colour          error bars under a coloured residual
force_noise     whether noise seems to enter at the forces
free_modes      that other model: free residues at free poles
reach           whether the inputs move every output
"""
