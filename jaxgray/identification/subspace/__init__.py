"""From filtered records to a realisation and its physical parameters, in closed form.

filter_bank   the λ-filters, as one Laguerre family per time constant
correlation   Gram matrix of the filtered rows, from correlations
compression   one triangular factor of the filtered record
projection    past, future and the oblique projection between them
realization   state-space model whose states are displacement and velocity
input_matrix  least squares for B₂ = M⁻¹ E
physical      mass, damping and stiffness by conic programs
grid          every time constant × block rows from one factor per time constant
"""
