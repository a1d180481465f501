"""Files kept for later processes: in folders that nobody else can change, read only where they are whole."""

import os
import stat
import threading

import equinox as eqx
import jax
import pytest

from jaxgray.mechanics.systems.drives import Force
from jaxgray.mechanics.systems.step_rows import Plant
from jaxgray.numerics.programs import kept_files
from jaxgray.numerics.programs.kept_files import NotPrivate, private_folder, read_kept, write_kept
from jaxgray.numerics.programs.result_forms import Unknown, form_of, form_text

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners here")


def mode(path):
    return stat.S_IMODE(os.lstat(path).st_mode)


def test_folders_are_made_for_their_owner_alone(tmp_path):
    before = os.umask(0)
    try:
        made = private_folder(tmp_path / "home" / "cache" / "kept")
    finally:
        os.umask(before)
    assert made == tmp_path / "home" / "cache" / "kept"
    assert [mode(path) for path in (made, made.parent, made.parent.parent)] == [0o700] * 3
    assert private_folder(made) == made


@pytest.mark.parametrize("others", [0o020, 0o002, 0o022])
@pytest.mark.parametrize("which", ["kept", "."])
def test_folders_that_others_may_write_to_are_refused(tmp_path, others, which):
    kept = private_folder(tmp_path / "kept")
    changed = tmp_path / which
    changed.chmod(0o755 | others)
    with pytest.raises(NotPrivate, match=f"others may write to {changed.resolve()} .*chmod go-w"):
        private_folder(kept)
    changed.chmod(0o755)
    assert private_folder(kept) == kept


def test_a_parent_with_the_sticky_bit_serves_and_the_folder_itself_does_not(tmp_path):
    kept = private_folder(tmp_path / "kept")
    tmp_path.chmod(0o1777)
    assert private_folder(kept) == kept
    kept.chmod(0o1777)
    with pytest.raises(NotPrivate):
        private_folder(kept)


def test_nothing_is_made_in_a_folder_that_others_may_write_to(tmp_path):
    tmp_path.chmod(0o777)
    with pytest.raises(NotPrivate):
        private_folder(tmp_path / "one" / "two")
    assert not list(tmp_path.iterdir())


def test_links_are_followed_and_every_folder_on_the_way_is_checked(tmp_path):
    safe, open_to_all = tmp_path / "safe", tmp_path / "open"
    safe.mkdir()
    open_to_all.mkdir()
    private_folder(safe / "kept")
    (open_to_all / "there").symlink_to(safe)
    (safe / "way").symlink_to("../open/there")
    assert private_folder(safe / "way" / "kept") == safe / "way" / "kept"
    open_to_all.chmod(0o777)
    # Where the link between lies, anybody can put another.
    with pytest.raises(NotPrivate, match="open"):
        private_folder(safe / "way" / "kept")
    (safe / "round").symlink_to(safe / "round")
    with pytest.raises(OSError):
        private_folder(safe / "round")


def test_folders_of_somebody_else_are_refused(tmp_path, monkeypatch):
    kept = private_folder(tmp_path / "kept")
    found = os.lstat

    def of_somebody(path, owner):
        def lstat(asked, **keywords):
            values = list(found(asked, **keywords))
            if os.fspath(asked) == os.fspath(path):
                values[4] = owner
            return os.stat_result(values)

        return lstat

    stranger = os.getuid() + 1
    for path in (kept, tmp_path):
        monkeypatch.setattr(os, "lstat", of_somebody(path, stranger))
        with pytest.raises(NotPrivate, match=f"{path} belongs to user {stranger}"):
            private_folder(kept)
    # The superuser could do anything anyway.
    monkeypatch.setattr(os, "lstat", of_somebody(tmp_path, 0))
    assert private_folder(kept) == kept


def test_a_file_in_the_place_of_a_folder_is_an_error_of_the_system(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        private_folder(tmp_path / "file" / "kept")
    with pytest.raises(OSError, match="not an absolute path"):
        private_folder(os.path.join("~", ".cache"))


def test_what_is_kept_comes_back_and_is_replaced(tmp_path):
    path = tmp_path / "entry"
    for content in (b"first", b"", b"\0" * 5000):
        assert write_kept(path, content)
        assert read_kept(path) == content
    assert mode(path) == 0o600 and list(tmp_path.iterdir()) == [path]


def test_every_flipped_bit_and_every_truncation_is_seen(tmp_path):
    path = tmp_path / "entry"
    write_kept(path, b"content")
    whole = path.read_bytes()
    for k in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[k // 8] ^= 1 << k % 8
        path.write_bytes(damaged)
        assert read_kept(path) is None
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        assert read_kept(path) is None
    path.write_bytes(whole + b"\0")
    assert read_kept(path) is None


def test_entries_of_others_and_other_things_are_left_alone(tmp_path):
    path = tmp_path / "entry"
    write_kept(path, b"content")
    os.link(path, tmp_path / "another")
    assert read_kept(tmp_path / "another") is None
    path.chmod(0o622)
    assert read_kept(path) is None
    path.unlink()
    os.mkfifo(path)
    found = []
    reader = threading.Thread(target=lambda: found.append(read_kept(path)), daemon=True)
    reader.start()
    reader.join(5)
    assert found == [None]
    assert read_kept(tmp_path) is None
    assert write_kept(path, b"again") and read_kept(path) == b"again"


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "entry"
    write_kept(path, b"content")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_files.os, "replace", full)
    assert not write_kept(path, b"other")
    assert read_kept(path) == b"content" and list(tmp_path.iterdir()) == [path]
    assert not write_kept(tmp_path / "missing" / "entry", b"other")


class Foreign(eqx.Module):
    """Not of the package."""

    value: int


PLANT = Plant(0, None, 1, Force(2), ("displacement", "velocity"))


@pytest.mark.parametrize("tree", [0, None, (0, [1, None]), {"a": 0, "b": (1,)}, (PLANT, 3), ()])
def test_forms_come_back_from_text(tree):
    form = jax.tree_util.tree_structure(tree)
    assert form_of(form_text(form)) == form


@pytest.mark.parametrize("tree", [Foreign(0), {1: 0}, (Foreign(0),)])
def test_other_forms_are_not_written(tree):
    with pytest.raises(Unknown):
        form_text(jax.tree_util.tree_structure(tree))


@pytest.mark.parametrize(
    "text",
    [
        '["class", ["os", "system"], {}]',
        '["class", ["jaxgray.cli", "main"], {}]',
        '["class", ["jaxgray.numerics.programs.kept_files", "NotPrivate"], {}]',
        '["class", ["jaxgray.numerics.programs.kept_files", "os"], {}]',
        '["run", "id"]',
    ],
)
def test_nothing_but_forms_is_read(text):
    with pytest.raises(Unknown):
        form_of(text)
