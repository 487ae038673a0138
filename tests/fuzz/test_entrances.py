"""Whatever is given to an entrance, it answers or says in one line what is wrong; see `python -m tests.fuzz`."""

import subprocess
import sys
import time

import numpy as np
import pytest

from . import commands
from .__main__ import one
from .entrances import ENTRANCES
from .judge import BrokenError, judged

FEW = {"read-policy": 6, "read-config": 20, "command-jaxsand": 40, "command-train": 4, "command-heavy": 0}
COMPILED = ("step", "follow", "settle", "scoop", "dump", "deposit", "rollout")
FEW |= {f"call-{name}": 12 for name in COMPILED}
MANY = {"read-policy": 200, "command-train": 150, "command-heavy": 8}
"""Cases of an entrance where they are not 30, or 400 among the slow ones: 10,000 in all."""


def thrown(name, count, tmp_path, monkeypatch, seed=0):
    """Runs so many cases of an entrance, each in a folder of its own."""
    for number in range(count):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        try:
            one(name, number, folder, seed)
        except BrokenError as error:
            pytest.fail(f"case {number} of {name}: {error}")


@pytest.fixture(autouse=True)
def _cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.parametrize("name", ENTRANCES)
def test_a_few_cases(name, tmp_path, monkeypatch):
    thrown(name, FEW.get(name, 30), tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("name", ENTRANCES)
def test_ten_thousand_cases(name, tmp_path, monkeypatch):
    thrown(name, MANY.get(name, 400), tmp_path, monkeypatch, seed=1)


def test_as_many_as_it_says():
    assert sum(FEW.get(name, 30) for name in ENTRANCES) > 500
    assert sum(MANY.get(name, 400) for name in ENTRANCES) > 10_000


@pytest.mark.slow
def test_real_commands(tmp_path):
    """As of a terminal: a process each, with what its interpreter says at its end."""
    rng = np.random.default_rng(5)
    for number in range(12):
        folder = tmp_path / str(number)
        folder.mkdir()
        commands.write(rng, folder)
        words = [
            "settle",
            commands.value(rng, "settle-in"),
            "--out-file",
            commands.value(rng, "out-file"),
            "--tol",
            commands.value(rng, "tol"),
        ]
        words = [word.replace("\0", "") for word in words]
        done = subprocess.run(
            [sys.executable, "-m", "jaxsand", *words], cwd=folder, capture_output=True, check=False, timeout=120
        )
        said = done.stderr.decode()
        assert done.returncode in (0, 2), said
        assert "Traceback" not in said
        if done.returncode == 2:
            assert commands.LINE.fullmatch(said), said
            assert not done.stdout


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda: {}["x"], "KeyError"),
        (lambda: [].index(3), "names nothing"),
        (lambda: (_ for _ in ()).throw(ValueError("x: a\nb")), "no line"),
        (lambda: np.float32(1e30) * np.float32(1e30), "RuntimeWarning"),
        (lambda: time.sleep(5), "HangError"),
        (lambda: "é".encode("ascii"), "UnicodeEncodeError"),
    ],
)
def test_the_judge_sees_faults(fault, said):
    with pytest.raises(BrokenError, match=said):
        judged(fault, 0.2)


def test_the_judge_of_commands_sees_faults(tmp_path):
    def main(words):
        print({"two": "error: a: b; c\nmore", "code": "", "loose": "error: what"}.get(words[0], ""), file=sys.stderr)
        (tmp_path / "out.json").write_text("{" if words[0] == "cut" else "{}")
        return {"code": 1, "cut": 0}.get(words[0], 2)

    for word, said in (
        ("two", "not one line"),
        ("loose", "not one line"),
        ("code", "ended with 1"),
        ("cut", "Expecting"),
        ("x", "not one line"),
    ):
        (tmp_path / "out.json").unlink(missing_ok=True)
        with pytest.raises((commands.CrashError, ValueError), match=said):
            commands.run(main, [word], tmp_path, ())
