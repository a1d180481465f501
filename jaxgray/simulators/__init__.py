"""Simulators of other programs as functions that a diagnosis runs: y = f(u, w, θ).

mujoco   models of MuJoCo: joints as coordinates, actuators as inputs
"""

from .mujoco import MujocoSimulator

__all__ = ["MujocoSimulator"]
