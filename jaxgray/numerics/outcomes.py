"""Every way a computation can fail, each with its remedy.

Wrong arguments are a `ValueError` before any computing; what goes wrong numerically is a member
of `RESULTS`, carried through traced code as an integer and raised at the end as a
`ComputationError` that says at which stage, why, and what to try.
"""

import equinox as eqx


class RESULTS(eqx.Enumeration):
    """The outcome of a computation; `successful` or a named failure with its remedy."""

    successful = ""
    too_short = (
        "The record is too short for what is to be estimated from it. Use a longer record, fewer block rows, or a "
        "lower sampling rate."
    )
    not_exciting = (
        "The input does not excite the system: its filtered copies are linearly dependent. Use an input "
        "that changes more often (steps with random hold times, PRBS, multisine), or fewer block rows."
    )
    order_not_found = (
        "The record does not contain as many states as the model asks for (two per coordinate). Check that "
        "every output measures its own coordinate and that the inputs move all of them."
    )
    negative_real_pole = (
        "A discrete-time pole lies on the negative real axis, so that no continuous-time model exists. Use "
        "fewer block rows, another time constant, or a higher sampling rate."
    )
    singular_state_basis = (
        "The outputs do not determine displacements and velocities: two outputs measure the same coordinate, "
        "or velocity or acceleration is measured on a coordinate without stiffness. Measure one output per "
        "coordinate, and displacement where there is no stiffness."
    )
    unreachable = (
        "The inputs do not reach some coordinate, so that its mass cannot be told from this record. Excite "
        "that coordinate too, give the input map, or fix the entries you know."
    )
    unstable_start = (
        "No stable starting model was found. Try other time constants and block rows, or check the record "
        "for closed-loop operation, drift and clipping."
    )
    semidefinite_solver = (
        "The semidefinite least-squares solver did not converge. Rescale the record or fix entries that you know."
    )
    refinement_diverged = (
        "The refinement did not converge from any start. Try without refinement, another time constant, or "
        "fix entries that you know."
    )
    not_improved = (
        "The refinement ended no better than its start, which is kept. Try another time constant, a longer record, or "
        "fix entries that you know."
    )
    simulator_failed = (
        "The simulator that was given gives no outputs that can be used. Run it with these inputs, mend it, or give "
        "other numbers."
    )
    not_reproduced = (
        "No model of the catalogue moves as the simulation does, so there is none to compare the machine with. Give "
        "the simulator itself, or more coordinates of it."
    )
    nonfinite = "The computation produced infinite or undefined values. Check the record's scale and offsets."


class ComputationError(RuntimeError):
    """A computation failed for a numerical reason.

    **Attributes:** `result`, the member of `RESULTS`; `stage`, a word or two on where it happened;
    `detail`, what was seen.
    """

    def __init__(self, result: RESULTS, *, stage: str, detail: str = ""):
        self.result = result
        self.stage = stage
        self.detail = detail
        message = f"{stage}: {detail + '. ' if detail else ''}{RESULTS[result]}"
        super().__init__(message)
