"""A release: one place for the version, a changelog that has it, extras that can be installed."""

import importlib.util
import re
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import npdr_ppl

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
WORKFLOWS = ROOT / ".github" / "workflows"


def check_release():
    """The module in .ci, whose file has no ending."""
    loader = SourceFileLoader("check_release", str(ROOT / ".ci" / "check_release"))
    module = importlib.util.module_from_spec(
        importlib.util.spec_from_loader("check_release", loader)
    )
    loader.exec_module(module)
    return module


def pins():
    """Returns the version that constraints.txt has for each distribution."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): pinned for name, pinned in pairs}


def missing_pins(requirements, known):
    """Returns the requirements that no pinned version meets, with those of what is installed."""
    missing, todo, seen = set(), [Requirement(text) for text in requirements], set()
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        key = (name, frozenset(requirement.extras))
        if name not in known or not requirement.specifier.contains(known[name], prereleases=True):
            missing.add(str(requirement))
        if key in seen:
            continue
        seen.add(key)
        try:
            needed = distribution(name).requires or []
        except PackageNotFoundError:
            continue
        for text in needed:
            below = Requirement(text)
            chosen = ("", *requirement.extras)
            if not below.marker or any(below.marker.evaluate({"extra": e}) for e in chosen):
                todo.append(below)
    return missing


def test_code_reads_the_version_from_the_package():
    assert npdr_ppl.__version__ == version("npdr-ppl") == PROJECT["version"]


def test_no_other_file_has_the_version():
    assert not re.search(r"^version:", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    for path in (ROOT / "npdr_ppl").rglob("*.py"):
        assert not re.search(r"__version__ *=", path.read_text()), path


def test_the_changelog_begins_with_the_version():
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest and newest[1] == PROJECT["version"]


@pytest.mark.parametrize(
    ("tag", "heading", "fault"),
    [
        ("v1.2.0", "1.2.0 – 2026-12-01", None),
        ("v1.2.1", "1.2.0 – 2026-12-01", "tag v1.2.0"),
        ("1.2.0", "1.2.0 – 2026-12-01", "tag v1.2.0"),
        ("v1.2.0", "1.2.0 – not released", "not released"),
        ("v1.2.0", "1.1.0 – 2026-12-01", "1.1.0"),
    ],
)
def test_a_tag_must_fit_version_and_changelog(tag, heading, fault):
    changelog = f"# Changelog\n\n## {heading}\n\n- A line.\n\n## 1.0.0 – 2026-01-01\n"
    found = check_release().fault(tag, "1.2.0", changelog)
    assert found is None if fault is None else fault in found


@pytest.mark.parametrize("extra", [None, *EXTRAS])
def test_constraints_has_a_version_for_every_requirement(extra):
    requirements = PROJECT["dependencies"] if extra is None else EXTRAS[extra]
    assert not missing_pins(requirements, pins())


@pytest.mark.parametrize("extra", [None, *EXTRAS])
def test_installed_requirements_are_the_versions_of_constraints(extra):
    known = pins()
    for text in PROJECT["dependencies"] if extra is None else EXTRAS[extra]:
        name = canonicalize_name(Requirement(text).name)
        try:
            found = version(name)
        except PackageNotFoundError:
            continue
        # A build of torch is named behind a plus sign.
        assert found.partition("+")[0] == known[name], name


def test_a_requirement_without_a_pin_is_found():
    known = pins()
    del known["numpy"]
    assert any("numpy" in text for text in missing_pins(["scipy>=1.13"], known))
    assert missing_pins(["numpy>=999"], pins()) == {"numpy>=999"}


def test_the_offline_install_uses_every_extra():
    script = (ROOT / ".ci" / "offline_install").read_text()
    assert set(re.findall(r"^  \[(\w+)\]=", script, re.MULTILINE)) == {"none", *EXTRAS}


def test_only_a_tag_publishes_and_only_after_the_tests():
    # YAML reads the key "on" as a truth value.
    publish = yaml.safe_load((WORKFLOWS / "publish.yml").read_text())
    assert publish[True] == {"push": {"tags": ["v*"]}}
    steps = [step.get("run", "") for step in publish["jobs"]["build"]["steps"]]
    commands = [step for step in steps if step]
    assert commands[0].startswith(".ci/check_release")
    assert commands.index(".ci/run") < commands.index("make dist")
    job = publish["jobs"]["publish"]
    assert job["needs"] == "build"
    assert job["permissions"] == {"id-token": "write"}
    assert publish["permissions"] == {"contents": "read"}


def test_every_push_is_tested():
    tested = yaml.safe_load((WORKFLOWS / "test.yml").read_text())
    assert {"push", "pull_request"} <= set(tested[True])
    assert ".ci/run" in [step.get("run") for step in tested["jobs"]["test"]["steps"]]
