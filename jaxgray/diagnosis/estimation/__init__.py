"""Refits of one structure: M, D, K, first states and the parameters of the laws.

context           what every refit needs
normal_equations  whitened residuals and Jacobians as products
gauss_newton      Gauss-Newton over cone and bounds, with geodesic acceleration
significance      evidence, size in standard errors, bounds
measured_motion   start with the force of a law along the measured motion
profile_scan      restart from a scan over one shape parameter (variable projection)
change_points     times of sudden changes: scan, annealed edges, likelihood interval
element_sums      thresholds of sums of play or slip elements
continuation      refits carried to convergence: noise renewed, valleys followed, steps shortened
multistart        refits of the candidates of a round, compared under one noise model
"""
