"""Runs of a user's simulator, and the linear plant that stands for it about them.

calls         the simulator as it is called, side by side, and what is said where it fails
linearized    the linear plant that it is for small forces, and forces that give a motion
numbers       its numbers as what a refit moves beside the laws
tracking      the force that brings it to the record, and the force that every number takes
forecast      that force where runs still leave the record, by what it was along the motion before
problem       records and simulator together: runs and their parts, data for the linear plant
"""

from .problem import Problem

__all__ = ["Problem"]
