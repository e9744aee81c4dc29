"""``mpsfm plugins new``: a package with a provider that passes its contract as it is."""

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
_OPENCV = ("features", "retrieval")


def write_plugin(name: str, kind: Kind, folder: Path) -> list[Path]:
    """Write the package ``name`` with a provider of that name into ``folder / name``.

    Returns the files. Raises :class:`~mpsfm_core.data.errors.InputError` when the name is no good,
    or when there is something in that place. """
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name) or keyword.iskeyword(module):
        raise InputError(f"{name!r} is not made of lower-case letters, digits and single dashes")
    if importlib.util.find_spec(module) is not None:
        raise InputError(f"there is a module {module!r} already: choose another name")
    target = folder / name
    if target.exists():
        raise InputError(f"{target} exists already")
    words = {
        "name": name,
        "module": module,
        "Class": "".join(part.capitalize() for part in name.split("-")),
        "kind": kind,
        "dependencies": '"mpsfm-core>=0.1", "numpy>=1.26"'
        + (', "opencv-python-headless>=4.8"' if kind in _OPENCV else ""),
    }
    words["usage"] = _filled(_TEMPLATES / kind / "usage.yaml", words).strip()
    has_contract = (_TEMPLATES / kind / "contract.py").exists()
    row = f"| `{module}/contract.py` | how the contract is checked without weights |\n"
    words["contract_row"] = row if has_contract else ""
    sources = {Path("pyproject.toml"), Path("README.md"), Path("tests/test_contract.py")}
    files = {target / path: _TEMPLATES / "common" / path for path in sources}
    files |= {target / module / p.name: p for p in (_TEMPLATES / kind).glob("*.py")}
    texts = {path: _filled(source, words) for path, source in files.items()}
    texts[target / module / "__init__.py"] = ""
    for path, text in texts.items():
        write_file(path, text)
    return sorted(texts)


def _filled(template: Path, words: dict[str, str]) -> str:
    return Template(template.read_text(encoding="utf-8")).substitute(words)
