"""What an identification works on.

options       what the user asks for, as objects
structure     what is free in M, D and K, assembled from positive semidefinite blocks
units         scaled coordinates, and back
padding       lengths that records are padded to
preparation   records as scaled, padded arrays
prediction    prediction errors of a mechanical model
"""
