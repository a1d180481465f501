"""Many records side by side: the traced, vmapped twin of `identify`.

stamped  batches of records with rows at times of their own
many     the pipeline
start    subspace start of one record
steps    refinement of one record
result   the models, and how each came out
"""
