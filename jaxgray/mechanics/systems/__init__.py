"""Linear systems.

statespace       realisations, sampled for a hold
drives           forces or a moving base as input
step_rows        what one step of a sample does to motion
abstract_model   what every model can be asked
modal, zeros     modes and antiresonances
units            units of what is measured
"""
