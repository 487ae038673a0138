"""The faults that tests are judged by (`python -m tests.faults`) can all be planted in the tree as it is."""

import subprocess

from .faults.__main__ import HERE, about, copied, package

FAULTS = sorted(HERE.glob("*.patch"))


def test_there_are_forty_faults_or_more_in_every_package():
    assert len(FAULTS) >= 40
    packages = {path.parent.name for path in (HERE.parents[1] / "jaxsand").glob("*/__init__.py")} | {"train"}
    assert {package(fault) for fault in FAULTS} == packages


def test_each_fault_changes_the_tree(tmp_path):
    copy = copied(tmp_path)
    for fault in FAULTS:
        check = ["git", "apply", "--check", "-v", str(fault)]
        done = subprocess.run(check, cwd=copy, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "Checking patch" in done.stderr
        assert about(fault).endswith(".")
