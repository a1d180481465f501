"""One record that is larger than a machine: its chunks on many workers, as exact as one pass.

source       where samples come from, a chunk at a time
factors      factors of chunks, and how they join over the seams
compressed   the record reduced by all workers, and its model
refinement   normal equations summed over workers
"""
