"""One import package from four folders: what ships, what links, what imports what."""

import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINKED = ("models", "inference", "policies")
DATA_FILES = (
    "py.typed",
    "models/furuta.xml",
    "display/reports/templates/report.html",
    "drawing/drawings.css",
)


def packages():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]


def test_packages_on_disk_are_the_ones_that_ship():
    found = {"npdr_ppl"}
    for folder in ("npdr_ppl", *LINKED):
        for init in (ROOT / folder).rglob("__init__.py"):
            parts = init.parent.relative_to(ROOT).parts
            if parts[0] in LINKED:
                parts = ("npdr_ppl", *parts)
            found.add(".".join(parts))
    assert found == set(packages())


@pytest.mark.parametrize("folder", LINKED)
def test_links_point_at_the_root_folders(folder):
    link = ROOT / "npdr_ppl" / folder
    assert link.is_symlink()
    assert link.resolve() == ROOT / folder


def test_layers_hold():
    found = subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports")],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stdout


def test_import_is_quick_and_brings_no_engine_or_plots():
    script = (
        "import time; start = time.perf_counter(); import npdr_ppl; "
        "took = time.perf_counter() - start; import sys; "
        "heavy = {'mujoco', 'pybullet', 'matplotlib', 'arviz', 'typer'} & set(sys.modules); "
        "assert not heavy, heavy; assert took < 2, took"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


@pytest.mark.slow
def test_the_distributions_hold_everything_outside_the_checkout(tmp_path):
    # From a copy, because setuptools leaves a build folder that would ship stale files next time.
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(".venv", ".git", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, symlinks=True, ignore=ignored)
    # The wheel is made of the source distribution, so that neither lacks a file.
    build = [sys.executable, "-m", "build", "--outdir", str(tmp_path / "dist"), str(source)]
    built = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert len(list((tmp_path / "dist").glob("*.tar.gz"))) == 1
    with zipfile.ZipFile(wheel) as archive:
        shipped = set(archive.namelist())
        (name,) = (name for name in shipped if name.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(archive.read(name))
    assert {f"npdr_ppl/{name}" for name in DATA_FILES} <= shipped
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert set(metadata.get_all("Provides-Extra", [])) == set(extras)
    environment = tmp_path / "environment"
    # Dependencies come from this environment, the package itself from the wheel alone.
    venv.create(environment, with_pip=False)
    site = next((environment / "lib").glob("python*")) / "site-packages"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site),
         str(wheel)],
        check=True,
    )  # fmt: skip
    dependencies = [path for path in sys.path if path.endswith("site-packages")]
    script = (
        f"import sys; sys.path.extend({dependencies!r})\n"
        "import importlib, pkgutil, npdr_ppl\n"
        f"assert npdr_ppl.__file__.startswith({str(site)!r}), npdr_ppl.__file__\n"
        f"for name in {packages()!r}:\n"
        "    module = importlib.import_module(name)\n"
        "    for found in pkgutil.iter_modules(module.__path__, name + '.'):\n"
        "        importlib.import_module(found.name)\n"
        "for name in ('models', 'inference', 'policies'):\n"
        "    try:\n"
        "        importlib.import_module(name)\n"
        "    except ModuleNotFoundError:\n"
        "        continue\n"
        "    raise SystemExit(f'{name} landed in site-packages')\n"
    )
    python = environment / "bin" / "python"
    done = subprocess.run(
        [str(python), "-W", "ignore", "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
