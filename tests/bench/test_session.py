"""What was done on the page: changed, undone, saved, resumed after a kill."""

import errno
import json
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from conftest import refused

from pam_ocp import InputError, UnknownNameError
from pam_ocp.bench.made import World, own_plants, source_of
from pam_ocp.bench.session import (
    EMPTY,
    Session,
    SessionInUse,
    safe_name,
    saved_sessions,
    stored_file,
)


@pytest.fixture
def session(tmp_path):
    made = Session.new(tmp_path)
    yield made
    made.close()


def reopened(session):
    session.close()
    return Session(session.folder)


def test_a_new_session_is_empty_and_leaves_no_folder_when_nothing_was_done(tmp_path):
    session = Session.new(tmp_path)
    assert session.state == EMPTY
    session.close()
    assert not session.folder.exists()


def test_undo_and_redo_go_through_all_states_in_order(session):
    rng = np.random.default_rng()
    states = [session.state]
    for i in range(20):
        part = ["point", "plant"][rng.integers(2)]
        session.change(f"step {i}", **{part: {"value": float(rng.normal())}})
        states.append(session.state)
    for state in states[-2::-1]:
        session.undo()
        assert session.state == state
    session.undo()
    assert session.state == states[0]
    for state in states[1:]:
        session.redo()
        assert session.state == state


def test_a_change_after_undo_forgets_what_was_undone(session):
    session.change("a", point={"p": 1.0})
    session.change("b", point={"p": 2.0})
    session.undo()
    session.change("c", point={"p": 3.0})
    assert session.redo_label is None
    assert session.undo_label == "c"


def test_what_a_tab_remembers_is_no_step_and_stays_through_undo(session):
    session.change("a", point={"p": 1.0})
    session.remember("Data", unit="psi")
    assert session.undo_label == "a"
    session.undo()
    assert session.view("Data", "unit") == "psi"


def test_a_state_cannot_be_changed_by_who_gave_it(session):
    mine = {"values": [1.0]}
    session.change("a", point=mine)
    mine["values"].append(2.0)
    assert session.state["point"] == {"values": [1.0]}


def test_listeners_hear_what_changed_until_they_end(session):
    heard = []
    end = session.listen(heard.append)
    session.change("a", point={"p": 1.0}, chosen="data1")
    session.change("the same", point={"p": 1.0})
    session.undo()
    end()
    session.redo()
    assert heard == [frozenset({"point", "chosen"})] * 2


@pytest.mark.parametrize("value", [{"p": float("nan")}, {"p": np.zeros(2)}, {"p": object()}])
def test_what_json_cannot_hold_is_refused_and_changes_nothing(session, value):
    refused("cannot be saved", session.change, "a", point=value)
    assert session.state == EMPTY
    assert session.undo_label is None


def test_a_part_that_does_not_exist_is_named(session):
    refused("motions", session.change, "a", motion=[], error=UnknownNameError)


def test_members_of_lists_are_put_dropped_and_numbered(session):
    for name in ("one", "two"):
        session.put(name, "motions", {"id": session.fresh_id("motions"), "name": name})
    session.put("again", "motions", {"id": "motions1", "name": "uno"})
    assert [m["name"] for m in session.state["motions"]] == ["uno", "two"]
    session.drop("drop", "motions", "motions1")
    assert session.item("motions", "motions1") is None
    assert session.fresh_id("motions") == "motions3"


# ---- the disk ------------------------------------------------------------------------------------
def test_a_session_is_resumed_with_all_its_steps(session):
    session.change("a", point={"p": 1.0})
    session.change("b", point={"p": 2.0})
    session.undo()
    again = reopened(session)
    assert again.state["point"] == {"p": 1.0}
    assert (again.undo_label, again.redo_label) == ("a", "b")
    again.redo()
    assert again.state["point"] == {"p": 2.0}
    again.close()


def test_a_session_is_whole_after_its_process_was_killed_while_it_changed(tmp_path):
    code = """
    import sys
    from pathlib import Path
    from pam_ocp.bench.session import Session
    session = Session(Path(sys.argv[1]))
    i = 0
    while True:
        long = [{"id": "m", "long": "x" * 20000}]
        session.change(f"step {i}", point={"p": float(i)}, motions=long)
        print(i, flush=True)
        i += 1
    """
    folder = tmp_path / "killed"
    run = [sys.executable, "-c", textwrap.dedent(code), os.fspath(folder)]
    child = subprocess.Popen(run, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    for _ in range(12):
        last = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
    child.stdout.close()
    child.wait()
    session = Session(folder)  # its lock died with it
    assert session.state["point"]["p"] >= last  # what it said was done is done
    session.undo()
    assert session.undo_label is not None
    session.close()


def test_two_processes_do_not_hold_one_session(session):
    code = "import sys; from pathlib import Path; from pam_ocp.bench.session import Session\n"
    code += "Session(Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, os.fspath(session.folder)], capture_output=True, text=True
    )
    assert "SessionInUse" in done.stderr
    assert issubclass(SessionInUse, InputError)


@pytest.mark.parametrize(
    "damage",
    [
        b"",
        b"{}",
        b"[" * 500,
        b'{"format": "pam_ocp bench 1"}',
        b'{"format": "pam_ocp bench 1", "state": {"data": 3}}',
        b'{"format": "pam_ocp bench 1", "state": {}, "past": [3]}',
    ],
)
def test_a_damaged_session_is_refused_in_one_sentence(session, damage):
    session.change("a", point={"p": 1.0})
    session.close()
    (session.folder / "session.json").write_bytes(damage)
    for _ in range(2):  # and its lock is free again
        with pytest.raises(InputError, match=r"session\.json") as caught:
            Session(session.folder)
        assert not isinstance(caught.value, SessionInUse)


def test_saved_sessions_are_listed_the_newest_first(tmp_path):
    names = []
    for i in range(3):
        session = Session(tmp_path / f"s{i}")
        session.change("a", point={"p": 1.0})
        session.close()
        os.utime(session.folder / "session.json", (1000 + i, 1000 + i))
        names.append(session.id)
    assert [name for name, _ in saved_sessions(tmp_path)] == names[::-1]
    assert saved_sessions(tmp_path / "none") == []


# ---- files ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "name",
    [
        "../../etc/passwd",
        "..\\..\\boot.ini",
        "/etc/shadow",
        "C:\\a.csv",
        ".bashrc",
        "a\0b.csv",
        "<img src=x>.csv",
        "con\n.csv",
        "..",
        "",
        "x" * 4000 + ".csv",
    ],
)
def test_no_name_leads_out_of_the_folder_of_files(session, name):
    kept = session.store(name, b"1,2\n")
    place = stored_file(session.folder, kept)
    assert place.resolve().parent == (session.folder / "files").resolve()
    assert place.read_bytes() == b"1,2\n"
    assert len(kept) < 120


@pytest.mark.parametrize("name", ["../session.json", "a/b", "..", "a\0"])
def test_a_path_is_no_name_of_a_stored_file(session, name):
    refused("no name of a file", stored_file, session.folder, name)


def test_half_a_file_that_a_full_disk_left_is_not_believed(session):
    kept = session.store("a.csv", b"p,kappa\n1,2\n")
    place = stored_file(session.folder, kept)
    place.write_bytes(b"p,kap")
    with pytest.raises(InputError, match="not what was dropped on the page; drop the file again"):
        stored_file(session.folder, kept)
    refused("drop the file again", source_of, World(session.folder), {"file": kept})
    assert session.store("a.csv", b"p,kappa\n1,2\n") == kept
    assert stored_file(session.folder, kept).read_bytes() == b"p,kappa\n1,2\n"


def test_a_disk_that_is_full_leaves_nothing_of_a_file(session, monkeypatch):
    def half(self, content):
        with self.open("wb") as file:
            file.write(content[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", half)
    refused("No space left on device", session.store, "a.py", b"plant = None\n")
    assert list((session.folder / "files").iterdir()) == []


def test_what_a_killed_upload_left_is_no_plant(session):
    (session.folder / "files" / ".a.py.pam-part-0123456789ab.py").write_text("half = 1")
    kept = session.store("a.py", b"whole = 1\n")
    assert own_plants(session.folder) == {f"{kept}:whole": "whole (a.py)"}


def test_equal_names_with_other_contents_are_two_files(session):
    assert session.store("a.csv", b"1") != session.store("a.csv", b"2")
    assert session.store("a.csv", b"1") == session.store("a.csv", b"1")
    assert safe_name("Prüfstand 3.csv").endswith(".csv")


def test_the_file_is_plain_json_that_others_can_read(session):
    session.change("a", point={"p": 1.0})
    content = json.loads((session.folder / "session.json").read_text("utf-8"))
    assert content["state"]["point"] == {"p": 1.0}
