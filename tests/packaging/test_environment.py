"""Where the engine's packages come from: the zip's wheels, and torch from elsewhere only where its CPU build isn't served."""

from __future__ import annotations

import environment
import lock
import pytest

TARGET = lock.Target("linux-x64", "3.11")


@pytest.fixture
def pip(monkeypatch: pytest.MonkeyPatch):
    """Stand-ins for pip: what is installed, as name -> file; the index serves all but what is in `unserved`."""
    installed, unserved = {}, set()

    def fetch(target, leave_out=frozenset(), python=""):
        if unserved & (lock.pinned("bundle", target).keys() - leave_out):
            raise lock.LockError("no matching distribution")

    monkeypatch.setattr(environment, "fetch", fetch)
    monkeypatch.setattr(
        environment,
        "pip_requirements",
        lambda command, wheels, *options, python: installed.update(
            {name: (file, options) for name, (file, _) in wheels.items()}
        ),
    )
    return installed, unserved


def test_all_comes_from_the_wheels_of_the_zip(pip):
    environment.install_bundle(TARGET, "python", "any")
    installed, _ = pip
    assert installed.keys() == lock.pinned("bundle", TARGET).keys()
    assert all("--no-index" in options for _, options in installed.values())
    assert "+cpu" in installed["torch"][0]


def test_without_a_cpu_build_torch_comes_with_cuda(pip, capsys):
    installed, unserved = pip
    unserved.add("torch")
    environment.install_bundle(TARGET, "python", "any")
    assert installed.keys() == (lock.pinned("bundle", TARGET) | lock.pinned("cuda", TARGET)).keys()
    assert "+cpu" not in installed["torch"][0]
    assert "--no-index" not in installed["torch"][1]
    assert "CPU build" in capsys.readouterr().out


def test_torch_cpu_or_nothing(pip):
    pip[1].add("torch")
    with pytest.raises(lock.LockError):
        environment.install_bundle(TARGET, "python", "cpu")


def test_no_torch_when_not_wanted(pip):
    installed, unserved = pip
    unserved.add("torch")
    environment.install_bundle(TARGET, "python", "none")
    assert installed.keys() == lock.pinned("bundle", TARGET).keys() - {"torch"}


def test_another_missing_wheel_is_no_reason_for_cuda(pip):
    pip[1].add("scipy")
    with pytest.raises(lock.LockError):
        environment.install_bundle(TARGET, "python", "any")
