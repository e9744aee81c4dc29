"""Scaffold of a plugin package from templates, for ``mpsfm plugins new``."""

from __future__ import annotations

import importlib.util
import keyword
import re
from pathlib import Path
from string import Template

from mpsfm_core.data.errors import InputError
from mpsfm_core.providers import Kind
from mpsfm_core.support.files import write_file

_TEMPLATES = Path(__file__).parent / "templates"
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_KINDS_WITH_OPENCV = ("features", "retrieval")


def write_plugin(name: str, kind: Kind, folder: Path) -> list[Path]:
    """Write a new plugin package with one provider that passes the contract checks.

    Args:
        name: Name of the Python package, the distribution and the provider.
        kind: Kind of the provider, such as ``depth``.
        folder: Parent folder of the plugin package.

    Returns:
        Paths of the written files.

    Raises:
        InputError: the plugin name is invalid or in use, or the package folder exists.
    """
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name) or keyword.iskeyword(module):
        raise InputError(f"{name!r} may only have lower-case letters, digits and single dashes")
    if importlib.util.find_spec(module) is not None:
        raise InputError(f"a module {module!r} exists: choose another name")
    target = folder / name
    if target.exists():
        raise InputError(f"{target} exists already")
    placeholders = {
        "name": name,
        "module": module,
        "Class": "".join(part.capitalize() for part in name.split("-")),
        "kind": kind,
        "dependencies": '"mpsfm-core>=0.1", "numpy>=1.26"'
        + (', "opencv-python-headless>=4.8"' if kind in _KINDS_WITH_OPENCV else ""),
    }
    placeholders["usage"] = _fill_template(_TEMPLATES / kind / "usage.yaml", placeholders).strip()
    has_contract = (_TEMPLATES / kind / "contract.py").exists()
    row = f"| `{module}/contract.py` | how the contract is checked without weights |\n"
    placeholders["contract_row"] = row if has_contract else ""
    sources = {Path("pyproject.toml"), Path("README.md"), Path("tests/test_contract.py")}
    files = {target / path: _TEMPLATES / "common" / path for path in sources}
    files |= {target / module / p.name: p for p in (_TEMPLATES / kind).glob("*.py")}
    texts = {path: _fill_template(source, placeholders) for path, source in files.items()}
    texts[target / module / "__init__.py"] = ""
    for path, text in texts.items():
        write_file(path, text)
    return sorted(texts)


def _fill_template(template: Path, placeholders: dict[str, str]) -> str:
    """Substitute the placeholders in the text of a template file."""
    return Template(template.read_text(encoding="utf-8")).substitute(placeholders)
