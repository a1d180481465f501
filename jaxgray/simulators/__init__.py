"""Simulators of other programs as functions that a diagnosis runs: y = f(u, w, θ).

mujoco   models of MuJoCo: joints as coordinates, actuators as inputs
fmu      functional mock-up units: variables as inputs, outputs, forces and numbers
mjcf     numbers of an MJCF, and laws written into it
inputs   what both share
"""

from .fmu import FmuSimulator
from .mujoco import MujocoSimulator

__all__ = ["FmuSimulator", "MujocoSimulator"]
