"""The command for the manual: open it in a browser, or write it to a folder."""

from pathlib import Path

from .arguments import Manual, Talk, takes_groups


@takes_groups
def docs(manual: Manual, talk: Talk) -> None:
    """Open the manual in a browser, or write it to a folder: pages that need no network.

    The pages are made the first time, which takes half a minute, and kept in the user's cache directory.
    """
    if manual.out is not None:
        _say(_built(manual.out, talk), talk)
        return
    import webbrowser

    from ..manual.site import key
    from .environment import user_cache

    kept = user_cache("manual")
    if kept is None:
        raise ValueError("the cache directory cannot be written; give a folder with --out.")
    first = kept / key() / "index.html"
    if not first.exists():
        first = _built(first.parent, talk)
    _say(first, talk)
    webbrowser.open(first.as_uri())


def _built(folder: Path, talk: Talk) -> Path:
    from ..manual import build
    from ..report import terminal

    with terminal.progress(quiet=talk.quiet, verbose=talk.verbose) as progress:
        progress.stage("writing the manual")
        from .environment import prepare

        prepare(verbose=talk.verbose, quiet=talk.quiet)
        return build(folder)


def _say(path: Path, talk: Talk) -> None:
    if not talk.quiet:
        print(path)
