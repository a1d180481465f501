"""A pendulum as a functional mock-up unit, written for pythonfmu: the equations of tests/pendulum.py once more."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

STEPS = 8
TURN = 1e-3


class Pendulum(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.inertia, self.damping, self.gravity, self.friction = 0.1, 0.08, 2.0, 0.15
        self.idle = 0.0
        self.torque, self.push, self.angle, self.speed = 0.0, 0.0, 0.0, 0.0
        for name in ("inertia", "damping", "gravity", "friction", "idle"):
            kind = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.tunable}
            self.register_variable(Real(name, **kind, start=getattr(self, name)))
        for name in ("torque", "push"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("angle", causality=Fmi2Causality.output))

    def _slope(self, q, v):
        force = self.torque + self.push - self.gravity * math.sin(q) - self.damping * v
        return v, (force - self.friction * math.tanh(v / TURN)) / self.inertia

    def do_step(self, current_time, step_size):
        dt = step_size / STEPS
        q, v = self.angle, self.speed
        for _ in range(STEPS):
            a = self._slope(q, v)
            b = self._slope(q + dt / 2 * a[0], v + dt / 2 * a[1])
            c = self._slope(q + dt / 2 * b[0], v + dt / 2 * b[1])
            d = self._slope(q + dt * c[0], v + dt * c[1])
            q += dt / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            v += dt / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        self.angle, self.speed = q, v
        return True
