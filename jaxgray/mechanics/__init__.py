"""Mechanical systems: what they are made of, how they move, and what else acts in them.

systems            matrices, drives, state space, modes and zeros
effects            the catalogue of laws
runs               motion under inputs and laws, and its derivatives
model              M, D, K with what drives and measures them
linear             a model with what some effects do to its linear part
describe, matrix_units    a model in words, its units
modal_uncertainty  error bars of modes and zeros
energy, passivity  the balance of a run; whether a linear part gives energy
fitted_run         a model run beside a record
at_stamps          the same at rows with times of their own
"""
