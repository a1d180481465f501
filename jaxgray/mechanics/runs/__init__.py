"""Motion of a system with laws.

simulate          the model's own face: free runs and first states
extended          a plant with effects at inputs, in its matrices, as forces, at outputs
trajectory        forces step by step
dry_friction      which way friction acts while bodies slide, reverse and rest
tangents          derivatives of a run along many directions
linearized        what a run answers to small further forces and inputs
first_state       first states that fit a record
force_over_time   a force given over time
"""
