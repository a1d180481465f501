"""A simulator whose own run leaves the record at once: a pendulum that a controller holds upright, and an arm."""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from found import model_findings

import jaxgray
from jaxgray.diagnosis.equation_error.band import Band
from jaxgray.diagnosis.equation_error.rows import series_of
from jaxgray.diagnosis.own_simulator.force_balance.equation import BalanceEquation

H, SAMPLES, TRUTH = 0.01, 1000, {"inertia": 0.1, "weight": 1.5, "damping": 0.2}


def acceleration(q, v, torque, numbers):
    return (torque + numbers["weight"] * np.sin(q) - numbers["damping"] * v) / numbers["inertia"]


class Upright:
    """The user's simulator: I q̈ + d q̇ = m g l sin q + u, by Runge and Kutta, several runs side by side."""

    def windows(self, first, u, w, numbers):
        q, v = first[:, 0].copy(), first[:, 1].copy()
        out = np.empty((len(q), u.shape[1], 1))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(u.shape[1]):
                out[:, k, 0] = q
                torque = u[:, k, 0] + w[:, k, 0]
                for _ in range(2):
                    q, v = self._step(q, v, torque, numbers, H / 2)
        return out

    def _step(self, q, v, torque, numbers, h):
        def slope(dq, dv):
            return v + dv, acceleration(q + dq, v + dv, torque, numbers)

        a = slope(0.0, 0.0)
        b = slope(h / 2 * a[0], h / 2 * a[1])
        c = slope(h / 2 * b[0], h / 2 * b[1])
        d = slope(h * c[0], h * c[1])
        return tuple(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4) for x, k1, k2, k3, k4 in zip((q, v), a, b, c, d))

    def __call__(self, u, w, numbers):
        return self.windows(np.zeros((1, 2)), u[None], w[None], numbers)[0]

    def momenta(self, q, v, numbers):
        return numbers["inertia"] * v

    def forces(self, q, v, a, u, numbers):
        return numbers["weight"] * np.sin(q) - numbers["damping"] * v, u.copy()


def machine(law, seed=3, noise=3e-4):
    """What a controller holds upright, by SciPy's integrator."""
    rng = np.random.default_rng(seed)
    wanted = scipy.signal.sosfilt(
        scipy.signal.butter(3, 0.7 * 2 * H, output="sos"), rng.standard_normal(SAMPLES), axis=0
    )
    wanted = 0.6 * wanted / wanted.std()
    state, u, y = np.zeros(2), np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        y[k] = state[0] + noise * rng.standard_normal()
        u[k] = 12.0 * (wanted[k] - y[k]) - 0.8 * ((y[k] - y[k - 1]) / H if k else 0.0)

        def slope(t, x, torque=u[k]):
            return [x[1], acceleration(x[0], x[1], torque + law(x[0], x[1]), TRUTH)]

        state = scipy.integrate.solve_ivp(slope, (0.0, H), state, rtol=1e-8, atol=1e-10).y[:, -1]
    return jaxgray.Record(u, y, H)


@pytest.fixture(scope="module")
def cubic():
    return machine(lambda q, v: -1.2 * q**3)


def test_a_law_is_named_along_a_motion_that_no_run_follows(cubic):
    # The wrong number of an axis that falls in its own run is told from the law.
    given = TRUTH | {"damping": 0.17}
    alone = Upright()(cubic.u, np.zeros_like(cubic.u), given)
    assert np.max(np.abs(alone[:300] - cubic.y[:300])) > np.std(cubic.y)
    rivals = ["cubic_stiffness", "quadratic_drag", "coulomb_friction"]
    found = jaxgray.diagnose(cubic, simulator=Upright(), parameters=given, only=rivals)
    number, law = model_findings(found)
    assert (number.effect, number.location) == ("parameter_error", "damping") and found.verdict == "named"
    assert abs(number.parameters["value"].value - 0.2) < 3 * number.parameters["value"].standard_error
    assert (law.effect, law.location) == ("cubic_stiffness", "y1")
    assert law.parameters["k3"].value == pytest.approx(1.2, rel=0.02)
    assert law.gain.held_out and law.gain.ci95[0] > 0
    assert "balance of its forces along the measured motion" in found.warnings[0]
    (shift,) = (one for one in found.shifts if one.name == "inertia")
    assert abs(shift.after - 0.1) < 3 * shift.standard_error


def test_nothing_is_said_of_a_simulator_that_is_right():
    record = machine(lambda q, v: 0.0, seed=5)
    found = jaxgray.diagnose(
        record, simulator=Upright(), parameters=TRUTH, only=["cubic_stiffness", "coulomb_friction"]
    )
    assert found.verdict == "noise" and model_findings(found) == []


def test_a_function_of_the_simulator_that_fails_is_said(cubic):
    class Wrong(Upright):
        def momenta(self, q, v, numbers):
            return numbers["mass"] * v

    class Flat(Upright):
        def momenta(self, q, v, numbers):
            return super().momenta(q, v, numbers)[:, 0]

    given, series = np.array(list(TRUTH.values())), [series_of(cubic, Band(0.0, 5.0))]
    for simulator, text in ((Wrong(), "its momenta raised KeyError: 'mass'"), (Flat(), "its momenta gave shape")):
        with pytest.raises(jaxgray.ComputationError, match=text):
            BalanceEquation(simulator, tuple(TRUTH), given, [cubic], series)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_the_equation_holds_along_its_own_motion(hold):
    rng, numbers = np.random.default_rng(2), {"inertia": 0.1, "weight": -1.5, "damping": 0.2}
    u = scipy.signal.sosfilt(scipy.signal.butter(3, 2 * H, output="sos"), rng.standard_normal((SAMPLES, 1)), 0)
    u = 0.5 * u / u.std()
    after = np.concatenate([u[1:], u[-1:]]) if hold == "linear" else u
    fine = np.stack([u + (after - u) * share for share in (np.arange(20) + 0.5) / 20], axis=1).reshape(-1)
    q, v, y = 0.0, 0.0, []
    for k, torque in enumerate(fine):
        if k % 20 == 0:
            y.append(q)
        q, v = Upright()._step(q, v, torque, numbers, H / 20)
    record = jaxgray.Record(u, np.array(y), H, hold=hold)
    series = [series_of(record, Band(0.0, 8.0))]
    equation = BalanceEquation(Upright(), tuple(numbers), np.array(list(numbers.values())), [record], series)
    assert equation.relative_error(equation.unmoved()) < 5e-3
    wrong = BalanceEquation(Upright(), tuple(numbers), np.array([0.11, -1.5, 0.2]), [record], series)
    fit = wrong.fit((), wrong.plain())
    assert np.allclose(wrong.numbers(fit), list(numbers.values()), rtol=1e-3)


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_an_arm_of_mujoco_says_what_makes_its_momenta(tmp_path, integrator):
    # Steps that let forces act early by half of one leave twice as much if that is not said.
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(
        f"""<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="{integrator}"/><worldbody><body>
        <joint name="a" type="hinge" axis="0 1 0" damping="0.3" armature="0.02"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/><body pos="0 0 -0.3">
        <joint name="b" type="hinge" axis="0 1 0" damping="0.15" armature="0.01"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.6"/><site name="tip" pos="0 0 -0.25"/>
        </body></body></worldbody><actuator><motor name="m" joint="a"/><motor name="n" joint="b" gear="2"/></actuator>
        </mujoco>"""
    )
    rng = np.random.default_rng(4)
    u = scipy.signal.sosfilt(scipy.signal.butter(3, 2 * H, output="sos"), rng.standard_normal((SAMPLES, 2)), 0)
    u = u / u.std(axis=0) * [1.2, 0.3]
    names = {"input_names": ["m", "n"], "output_names": ["a", "b"]}
    record = jaxgray.Record(u, np.zeros((SAMPLES, 2)), H, **names)
    simulator = jaxgray.MujocoSimulator(tmp_path / "arm.xml", record)
    y = simulator(u, np.zeros((SAMPLES, 2)), simulator.numbers)
    record = jaxgray.Record(u, y, H, **names)
    series = [series_of(record, Band(0.0, 12.0))]
    given = np.array(list(simulator.numbers.values()))
    equation = BalanceEquation(simulator, tuple(simulator.numbers), given, [record], series)
    assert equation.relative_error(equation.unmoved()) < 1e-3
    # Masses are positive, and an input acts where its motor does.
    assert np.all(np.linalg.eigvalsh(equation.mean_mass()) > 0)
    assert np.allclose(equation.mean_input_map(), np.diag([1.0, 2.0]), atol=1e-9)
    # A window that begins in a state of the run goes on as the run does.
    begin = 400
    speed = (y[begin + 1] - y[begin - 1]) / (2 * H)
    part = simulator.windows(
        np.concatenate([y[begin], speed])[None], u[None, begin : begin + 50], np.zeros((1, 50, 2)), simulator.numbers
    )[0]
    assert np.max(np.abs(part - y[begin : begin + 50])) < 0.02 * y.std()
