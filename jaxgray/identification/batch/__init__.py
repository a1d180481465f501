"""Many records side by side: the traced, vmapped twin of `identify`.

many    the pipeline
start   subspace start of one record
steps   refinement of one record
result  the models, and how each came out
"""
