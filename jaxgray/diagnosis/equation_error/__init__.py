"""The force equation E u = M q̈ + D q̇ + K q + Σ b φ, by regression on filtered signals.

band                        where motion stands above its noise, and motion by integrating accelerations
integrated_band             that band for integrated motion, by how well it explains itself
rows                        filtered signals of a record, and the forces of laws on them
regression                  M, D, K and the laws by least squares
library                     every law, place and shape, and its score
base_motion                 records on an accelerated base as records of forces
windows                     free runs over windows, by which models are judged
unmeasured_forces           brief forces that no input records
search                      which laws are in the equation
without_unmeasured_forces   the same with the samples of brief forces left out
"""
