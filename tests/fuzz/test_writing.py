"""Files are whole or not there: what a full disk, a folder that cannot be written to, or a kill leaves."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import jaxsand as js
from jaxsand.__main__ import main
from jaxsand.bench.kept import append_row, known_rows
from jaxsand.cli.arguments import ended
from jaxsand.cli.files import write_json
from jaxsand.goals.writing import written
from jaxsand.planning.waypoints import write_waypoints
from train.runs.runs import run as train

from ..train.test_runs import Tiny
from .judge import BrokenError
from .kills import JOBS, Job, child, killed_often, whole

HEIGHT = np.random.default_rng(0).normal(size=(40, 40))
ROOT = Path(__file__).parents[2]


@contextmanager
def room(size):
    """No file can grow beyond so many bytes, as on a full disk: the system itself refuses to write."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def page(path):
    js.view(HEIGHT, spacing=0.01).to_html(path)


WRITERS = {
    **{
        f"x.{suffix}": lambda path: js.write_map(path, HEIGHT, spacing=0.01)
        for suffix in ("asc", "npz", "npy", "png", "ply", "stl", "hfield")
    },
    "y.json": lambda path: write_waypoints(path, HEIGHT[:, :4]),
    "y.csv": lambda path: write_waypoints(path, HEIGHT[:, :4]),
    "z.json": lambda path: write_json(path, {"a": HEIGHT.tolist()}),
    "z.html": page,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_was_there(tmp_path, name):
    path = tmp_path / name
    path.write_text("old")
    with (
        room(500),
        pytest.raises(ValueError, match=rf"^(path|file|out): cannot write .*{name} \(.+\); make room, or choose"),
    ):
        WRITERS[name](path)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == [name]
    WRITERS[name](path)
    assert path.stat().st_size > 500


def test_what_fails_within_leaves_what_was_there(tmp_path):
    target = tmp_path / "result.json"
    target.write_text("old")
    for error in (
        OSError(28, "No space left on device"),
        OSError("36 requested and 0 written"),
        KeyboardInterrupt(),
        KeyError("x"),
    ):
        with pytest.raises((ValueError, type(error))) as caught, written(target) as path:
            path.write_text("half")
            raise error
        if isinstance(error, OSError):
            assert str(caught.value).startswith(f"out: cannot write {target} ({error.strerror or error}); make room")
        assert target.read_text() == "old"
        assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_a_full_disk_cuts_no_row_of_a_bench_that_was_there(tmp_path):
    path = tmp_path / "rows.jsonl"
    for k in range(3):
        append_row(path, {"k": k, "text": "x" * 100})
    with room(400), pytest.raises(ValueError, match=r"^out: cannot write .*rows.jsonl \(.+\); make room .* stay good$"):
        append_row(path, {"k": 3, "text": "x" * 100})
    assert [row["k"] for row in known_rows(path, {"k"})] == [0, 1, 2]
    append_row(path, {"k": 4})
    assert [row["k"] for row in known_rows(path, {"k"})] == [0, 1, 2, 4]


@pytest.mark.parametrize(
    ("words", "files"),
    [
        (["plan", "S", "--out", "out"], ["plan-S.json", "plan-S.png"]),
        (["settle", "pile.npy", "--out-file", "out/x.npy"], ["x.npy"]),
        pytest.param(
            ["shape", "L", "--out", "out", "--html"],
            ["result.json", "shape.gif", "shape.html", "shape.png"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_command_on_a_full_disk_says_so_and_leaves_what_was_there(tmp_path, monkeypatch, capsys, words, files):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    np.save("pile.npy", np.eye(24, dtype=np.float32) * 0.05)
    Path("out").mkdir()
    for name in files:
        (Path("out") / name).write_text("old")
    with room(600):
        assert main(words) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("error: out: cannot write out/")
    assert err.count("\n") == 1
    assert {path.name: path.read_text() for path in Path("out").iterdir()} == dict.fromkeys(files, "old")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_what_cannot_be_printed_is_said(tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "jaxsand", "plan", "S"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert done.returncode == 2
    assert (
        done.stderr.decode()
        == "error: file: cannot use the output (No space left on device); choose another, or make room\n"
    )


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.EACCES, "Permission denied", "a/b"), "error: file: cannot use a/b (Permission denied); choose"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "x" * 5000), "error: file: cannot use xxx"),
        (MemoryError(), "error: memory: there is not enough; ask for less"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes"),
            "error: memory: there is not enough; ask for less",
        ),
    ],
)
def test_what_the_system_refuses_is_a_line(capsys, error, said):
    def work():
        raise error

    assert ended(work) == 2
    err = capsys.readouterr().err
    assert err.startswith(said)
    assert err.count("\n") == 1
    assert len(err) < 400


def test_a_fault_of_the_programs_own_is_not_hushed_up():
    def work():
        raise RuntimeError("a fault")

    with pytest.raises(RuntimeError, match="a fault"):
        ended(work)


def test_a_second_run_in_a_folder_is_refused_while_the_first_goes_on(tmp_path):
    pytest.importorskip("fcntl")
    out, second = tmp_path / "run", []

    def watch(row):
        if row["chunk"] == 3 and row["kind"] == "train":
            with pytest.raises(
                ValueError, match=r"^out: a run is going on in .*; wait for its end, or choose another folder$"
            ):
                train(Tiny(), out, 3, steps=9, resume=True)
            second.append(row["chunk"])

    assert train(Tiny(), out, 3, steps=9, watch=watch).chunk == 9
    assert second == [3]
    assert train(Tiny(), out, 3, steps=11, resume=True).chunk == 11


KEEP = """
import sys
from pathlib import Path
from jaxsand.bench.kept import append_row
for k in range(10**9):
    append_row(Path("rows.jsonl"), {"who": sys.argv[1], "k": k, "text": "x" * (k % 20000)})
"""


@pytest.mark.slow
def test_two_benches_that_are_killed_leave_rows_that_are_whole(tmp_path):
    path, chance = tmp_path / "rows.jsonl", random.Random(0)
    for _ in range(5):
        before, size = known_rows(path, {"who", "k"}), path.stat().st_size if path.exists() else 0
        benches = [child(["-c", KEEP, name], tmp_path) for name in "ab"]
        while not path.exists() or path.stat().st_size < size + 300_000:
            assert all(bench.poll() is None for bench in benches)
            time.sleep(0.01)
        time.sleep(0.3 * chance.random())
        for bench in benches:
            bench.kill()
            bench.communicate()
        rows = known_rows(path, {"who", "k"})
        assert rows[: len(before)] == before
        new = rows[len(before) :]
        assert new
        for name in "ab":
            numbers = [row["k"] for row in new if row["who"] == name]
            assert numbers == [*range(len(numbers))]


@pytest.mark.slow
def test_a_command_that_is_killed_leaves_whole_files(tmp_path):
    """Each file is the old one or the new one; `python -m tests.fuzz.kills` has more commands and more kills."""
    killed_often(JOBS["shape"], 6, tmp_path)


COUNT = """
import json, pathlib, sys, time
out = pathlib.Path("out")
out.mkdir(exist_ok=True)
config, kept = out / "config.json", out / "kept.json"
if not config.exists():
    (out / "part").write_text("{}")
    (out / "part").replace(config)
number = json.loads(kept.read_text()) if kept.exists() else 0
while number < 20:
    time.sleep(0.005)
    number += 1
    (out / "part").write_text(json.dumps(number))
    (out / "part").replace(kept)
"""
SPOILT = {
    "as it should be": ("", None),
    "forgets where it was": ('"--on" in sys.argv and kept.write_text("21")', "ends otherwise than undisturbed"),
    "leaves half a file": ("time.sleep(0.01); kept.write_text('{'); time.sleep(0.5)", "kept.json is not whole"),
    "is never the same": ("kept.write_text(str(time.time()))", "ends otherwise each time"),
    "fails": ("sys.exit('no more')", "ended with 1: no more"),
}


@pytest.mark.parametrize(("then", "said"), SPOILT.values(), ids=SPOILT)
def test_what_a_kill_breaks_is_seen(tmp_path, then, said):
    job = Job(["-c", COUNT + then], ["--on"], lambda out: (out / "kept.json").read_text())
    if said is None:
        assert killed_often(job, 4, tmp_path).startswith("4 kills")
        return
    with pytest.raises(BrokenError, match=said):
        killed_often(job, 40, tmp_path)


def test_a_file_that_is_cut_off_is_seen(tmp_path):
    from PIL import Image

    Image.fromarray(np.uint8(HEIGHT)).save(tmp_path / "a.png")
    np.savez(tmp_path / "a.npz", HEIGHT)
    write_json(tmp_path / "a.json", {"a": HEIGHT.tolist()})
    for path in sorted(tmp_path.iterdir()):
        whole(path)
        path.write_bytes(path.read_bytes()[:-30])
        with pytest.raises(BrokenError, match=f"{path.name} is not whole"):
            whole(path)


AS_OTHERS = """
import ctypes, os, sys
if os.geteuid() == 0:
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)  # PR_CAPBSET_DROP, CAP_DAC_OVERRIDE
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
"""Takes from root the right to write where nobody may, then starts a program."""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="root's rights are taken away as on Linux")
@pytest.mark.parametrize(
    "words",
    [
        ["plan", "S", "--out", "locked"],
        ["settle", "pile.npy", "--out-file", "locked/x.npy"],
        ["shape", "S", "--out", "locked/a"],
    ],
)
def test_a_read_only_folder_is_said(tmp_path, words):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    np.save(tmp_path / "pile.npy", np.eye(12, dtype=np.float32))
    done = subprocess.run(
        [sys.executable, "-c", AS_OTHERS, "-m", "jaxsand", *words],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "HOME": "/nowhere"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.decode().startswith("error: out: cannot write to locked")
    assert done.stderr.count(b"\n") == 1
    assert not [*folder.iterdir()]
