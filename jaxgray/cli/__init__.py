"""The command `jaxgray`: every error is one line, and its exit code says whose it is.

0 done, whatever the verdict; 2 wrong arguments or data; 3 the computation failed.

arguments    the options, each declared once, in groups that commands share
commands     the commands, one function each
diagnosing   those about a diagnosis: `diagnose`, `effects`, `demo`
fleet        the command for many records
docs         the command for the manual
schema       the command for the JSON Schema of documents
files        reading records and models, and where results may go
finishing    what all commands share at their end
environment  what must be set before jax computes
"""

import os
import sys
import warnings

WRONG_INPUT = 2
FAILED = 3
INTERRUPTED = 130
"""What shells have for Ctrl-C."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    **Arguments:** `argv`: its arguments; default those of the process, whose Python warnings are then kept
    from the screen unless it was started with `-W` or `--verbose`.

    **Returns:** the exit code.
    """
    if argv is None:
        argv = sys.argv[1:]
        if not sys.warnoptions and "--verbose" not in argv:
            warnings.simplefilter("ignore")
    # Before NumPy is loaded: on few cores the threads of BLAS and of jax take them from each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from .commands import app

    try:
        return _run(app, argv)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read the output has gone; Python would complain again when it closes the stream.
        sys.stdout = None
        return 0
    except SystemExit as left:
        # What puts shell completion in place ends so.
        return left.code if isinstance(left.code, int) else 0
    except Exception as error:
        if "--verbose" in argv:
            import traceback

            traceback.print_exc()
        code, text = explain(error)
        print("error: " + " ".join(text.split()), file=sys.stderr)
        return code


def _run(app, argv: list[str]) -> int:
    from typer.main import get_command

    command = get_command(app)
    if not argv:
        argv = ["--help"]
    result = command.main(args=argv, prog_name="jaxgray", standalone_mode=False)
    return result if isinstance(result, int) else 0


def explain(error: Exception) -> tuple[int, str]:
    """Exit code and one line for an error.

    **Arguments:** `error`.

    **Returns:** 2 for what the caller can mend by other arguments or data, else 3; and the text.
    """
    if hasattr(error, "format_message"):
        return WRONG_INPUT, error.format_message()
    if type(error).__name__ in ("Abort", "Exit"):
        return getattr(error, "exit_code", WRONG_INPUT), "stopped"
    name = type(error).__name__
    if name == "Interrupted":
        return INTERRUPTED, str(error)
    # A ValueError to NumPy, but nothing that another argument would have prevented.
    if name == "LinAlgError":
        return FAILED, f"linear algebra: {error}. Check the record's scale, or try another time constant."
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return WRONG_INPUT, f"{where}{error.strerror or error}."
    if isinstance(error, ValueError | ImportError):
        return WRONG_INPUT, str(error)
    if name in ("ComputationError", "Lost"):
        return FAILED, str(error)
    if isinstance(error, MemoryError):
        return FAILED, "not enough memory; use a shorter record, fewer time constants or fewer block rows."
    text = str(error).strip().splitlines()
    return FAILED, f"{name}: {text[0] if text else 'unexpected'} (--verbose shows where)"
