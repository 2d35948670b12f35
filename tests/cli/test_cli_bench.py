"""``pam-ocp bench``: what it refuses, and what it says where the extra is missing."""

import importlib.util

import pytest
from conftest import refused

from pam_ocp.bench.server import serve, sessions_folder
from pam_ocp.cli.main import main


def test_without_the_extra_it_says_in_one_sentence_what_to_install(monkeypatch, capsys):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n, *a: None if n == "nicegui" else real(n, *a)
    )
    assert main(["bench"]) == 2
    said = capsys.readouterr().err.strip()
    words = "the bench needs nicegui, which is not installed: pip install 'pam_ocp[bench]'"
    assert said == f"pam-ocp bench: {words}"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "rig.local"])
def test_others_are_let_in_by_a_password_only(host, tmp_path):
    pytest.importorskip("nicegui")
    refused("give a password", serve, host=host, folder=tmp_path)
    refused("9 characters", serve, host=host, folder=tmp_path, password="too short")


def test_sessions_are_kept_in_the_users_own_state_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    assert sessions_folder() == tmp_path / "pam_ocp" / "bench"
