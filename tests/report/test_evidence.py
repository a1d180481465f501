"""Evidence behind the pictures against known truth: missing forces, spectra, poles over the order; and the pictures."""

import dataclasses

import numpy as np
import pytest
import scipy.integrate
from independent import REFERENCE, REFERENCE_TIME, random_steps, simulate, smooth_noise
from made_diagnosis import diagnosis, equivalent, nothing

from jaxgray import MechanicalModel, Record, stabilisation
from jaxgray.diagnosis.conclusions.missing_force import missing_forces
from jaxgray.diagnosis.conclusions.spectra import spectra
from jaxgray.diagnosis.findings import Curves, Estimate, Finding, Member, ModelSummary
from jaxgray.mechanics.effects import Place, Term, by_id
from jaxgray.report.figures import diagnosis as diagnosis_figures
from jaxgray.report.figures import modal as modal_figures
from jaxgray.report.page.binning import binned, decided_by

H, CUBIC = 0.01, 400.0


@pytest.fixture(scope="module")
def hardening():
    """One mass on a hardening spring, driven by smooth noise, from SciPy; diagnosed as it is."""
    rng = np.random.default_rng(4)
    samples = 4000
    t = H * np.arange(samples)
    u = 6 * smooth_noise(rng, samples, 1, bandwidth=0.08)

    def slope(time, x):
        force = np.interp(time, t, u[:, 0])
        return [x[1], (force - 1.5 * x[1] - 80 * x[0] - CUBIC * x[0] ** 3) / 2.0]

    solved = scipy.integrate.solve_ivp(slope, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-10)
    y = solved.y[:1].T + 2e-5 * rng.standard_normal((samples, 1))
    units = {"input_units": ("N",), "output_units": ("m",)}
    record = Record(u, y, H, hold="linear", **units)
    made = MechanicalModel([[2.0]], [[1.5]], [[80.0]], **units)
    summary = ModelSummary(made, None, *[{"estimation": {"y1": 1.0}}] * 2)
    parameters = {"k3": Estimate(CUBIC, 8.0, "N/m^3")}
    member = Member("cubic_stiffness", "y1", 0.0, parameters)
    finding = Finding("cubic_stiffness", "y1", "named", "model", (member,), parameters, 900.0, None)
    return diagnosis(
        baseline=summary,
        extended=summary,
        noise_floor={"y1": 2e-5},
        findings=(finding,),
        terms=(Term(by_id("cubic_stiffness"), Place("y1", 0), np.array([CUBIC])),),
        records=(record,),
        validation_records=(),
        curves=(Curves(t, y, 0.9 * y, y, False),),
        shifts=(),
    )


def test_the_missing_force_is_the_law_that_was_simulated(hardening):
    (one,) = missing_forces(hardening)
    assert (one.effect, one.location, one.quantity, one.unit) == ("cubic_stiffness", "y1", "force", "N")
    names = [(variable.name, variable.unit) for variable in one.variables]
    assert names == [("displacement of y1", "m"), ("velocity of y1", "m/s"), ("time", "s"), ("input u1", "N")]
    q = one.variables[0].values
    size = np.std(CUBIC * q**3)
    assert np.sqrt(np.mean((one.missing - one.law) ** 2)) < 0.1 * size
    assert np.sqrt(np.mean((one.missing - CUBIC * q**3) ** 2)) < 0.1 * size
    np.testing.assert_allclose(one.error, np.abs(one.law) * 8.0 / CUBIC, rtol=1e-6, atol=1e-12)
    assert decided_by(q, one.law) and not decided_by(one.variables[1].values, one.law)


def test_a_wrong_law_is_seen_to_be_wrong(hardening):
    wrong = dataclasses.replace(hardening, terms=(dataclasses.replace(hardening.terms[0], values=np.array([200.0])),))
    (one,) = missing_forces(wrong)
    assert np.sqrt(np.mean((one.missing - one.law) ** 2)) > 0.3 * np.std(one.missing)


def test_what_is_left_is_shown_where_nothing_has_a_name(hardening):
    unnamed = Finding("unexplained", "y1", "unexplained", "model", (), {}, None, None)
    left = dataclasses.replace(hardening, verdict="unexplained", findings=(unnamed,), terms=(), extended=None)
    (one,) = missing_forces(left)
    assert one.law is None and one.effect == ""
    assert np.corrcoef(one.missing, one.variables[0].values ** 3)[0, 1] > 0.99
    assert missing_forces(dataclasses.replace(left, verdict="noise", findings=())) == ()


def test_effects_at_sensors_are_shown_at_the_output():
    offset = {"b": Estimate(-1e-3, 1e-4, "m")}
    finding = Finding("sensor_offset", "y1", "named", "model", (), offset, 80.0, None)
    term = Term(by_id("sensor_offset"), Place("y1", 0), np.array([-1e-3]))
    made = diagnosis(findings=(finding,), terms=(term,))
    (one,) = missing_forces(made)
    curves = made.curves[0]
    assert one.quantity == "output" and one.cutoff_hz is None
    np.testing.assert_allclose(one.missing, (curves.measured - curves.baseline)[:, 0])
    np.testing.assert_allclose(one.law, (curves.extended - curves.baseline)[:, 0])


def test_white_noise_lies_on_the_floor(hardening):
    rng = np.random.default_rng(8)
    noise = 2e-5 * rng.standard_normal((40_000, 1))
    t = H * np.arange(len(noise))
    record = Record(rng.standard_normal((len(noise), 1)), noise, H)
    curves = Curves(t, noise, np.zeros_like(noise), np.zeros_like(noise), False)
    made = spectra(dataclasses.replace(hardening, records=(record,), curves=(curves,)))
    assert made.period is None
    assert np.sqrt(np.mean(made.after**2)) == pytest.approx(made.floor[0], rel=0.03)


def test_lines_of_a_periodic_record_have_their_amplitudes(hardening):
    period, repeats = 500, 6
    t = H * np.arange(period * repeats)
    u = np.cos(2 * np.pi * 4 * t / (period * H)) + np.cos(2 * np.pi * 7 * t / (period * H))
    y = 0.3 * np.cos(2 * np.pi * 4 * t / (period * H)) + 0.02 * np.sin(2 * np.pi * 12 * t / (period * H))
    curves = Curves(t, y[:, None], 0 * y[:, None], 0 * y[:, None], False)
    record = Record(u[:, None], y[:, None], H)
    made = spectra(dataclasses.replace(hardening, records=(record,), curves=(curves,)))
    assert made.period == period
    assert np.flatnonzero(made.driven).tolist() == [3, 6]
    np.testing.assert_allclose(made.measured[[3, 11], 0], [0.3, 0.02], rtol=1e-9)
    np.testing.assert_allclose(made.frequency_hz[3], 4 / (period * H))


def test_means_over_bins():
    x = np.arange(400.0)
    centre, mean, spread = binned(x, 2 * x, 10)
    assert len(centre) == 5
    np.testing.assert_allclose(mean, 2 * centre)
    assert np.all(spread > 0)


@pytest.fixture(scope="module")
def poles():
    """Orders 2, 4, 6 of the reference system."""
    u = random_steps(np.random.default_rng(5), 4000, 2, REFERENCE_TIME, hold_times=(0.2, 1.0))
    y = simulate(*REFERENCE.values(), u, REFERENCE_TIME)
    noise = 1e-4 * np.random.default_rng(6).standard_normal(y.shape)
    return stabilisation(Record(u, y + noise, REFERENCE_TIME), orders=[4, 6], time_constant=0.05, block_rows=6)


def test_true_modes_stay_over_the_order(poles):
    M, D, K = REFERENCE.values()
    truth = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve(M, K)).real)) / (2 * np.pi)
    first = poles.frequency_hz[poles.order == 4]
    np.testing.assert_allclose(first, truth, rtol=0.02)
    assert np.sum(poles.stable[poles.order == 6]) == 2 and not poles.stable[poles.order == 4].any()
    np.testing.assert_allclose(poles.frequency_hz[poles.stable], truth, rtol=0.02)


def test_orders_beyond_the_block_rows_are_refused():
    rng = np.random.default_rng(1)
    record = Record(rng.standard_normal((600, 1)), rng.standard_normal((600, 1)), 0.01)
    with pytest.raises(ValueError, match=r"orders=\[8\]: 5 block rows of 1 outputs allow 1 to 4"):
        stabilisation(record, orders=[8], block_rows=5, time_constant=0.05)


def test_every_figure_of_a_diagnosis_is_drawn(hardening):
    for made in (hardening, diagnosis(), equivalent(), nothing(), nothing("unexplained", 2.8)):
        for name in diagnosis_figures.figures_of(made):
            getattr(diagnosis_figures, name)(made).canvas.draw()
    law = diagnosis_figures.missing_force(hardening)
    assert law.get_suptitle() == "cubic stiffness at y1"
    assert law.axes[0].get_xlabel() == "displacement of y1 [m]"
    with pytest.raises(ValueError, match="finding=1 is not there; there are 1"):
        diagnosis_figures.missing_force(hardening, finding=1)
    with pytest.raises(ValueError, match="no error budget"):
        diagnosis_figures.error_budget(nothing())
    shares = diagnosis_figures.error_budget(diagnosis()).axes[0].patches
    assert [bar.get_width() for bar in shares] == [87.0, 12.5, 0.5]


def test_modal_figures(identification, poles):
    figure = modal_figures.mode_shapes(identification)
    figure.canvas.draw()
    assert len(figure.axes) == 2 and "Hz" in figure.axes[0].get_title()
    shape = figure.axes[0].get_lines()[1].get_ydata()
    assert np.max(np.abs(shape)) == pytest.approx(1.0)
    assert len(modal_figures.mode_shapes(identification.model).axes) == 2
    drawn = modal_figures.stabilisation_diagram(poles).axes[0]
    stable = drawn.get_lines()[2]
    np.testing.assert_array_equal(stable.get_xdata(), poles.frequency_hz[poles.stable])
