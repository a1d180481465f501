"""Prediction-error refinement over physical matrices, and what the record determines of them.

normal_equations  products of errors and sensitivities in the entries of the blocks
cholesky          Levenberg-Marquardt on Cholesky factors
conic             Gauss-Newton with the cone as a constraint
continuation      fits over windows, first short ones, then longer
innovations       information about M, D, K beside noise at the forces
prior             what is assumed of masses under base excitation
refine            the stages in their order, guarded by the start
refine_traced     a fixed number of Gauss-Newton steps, in traced code
structured_start  the nearest model of a given structure
uncertainty       covariance, weak directions, entries at the edge
"""
