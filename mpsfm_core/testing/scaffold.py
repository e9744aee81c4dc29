"""Scaffold of a plugin package from templates, for ``mpsfm plugins new``."""

from __future__ import annotations

import importlib.util
import keyword
import re
from pathlib import Path
from string import Template

from mpsfm_core.data.errors import InputError
from mpsfm_core.providers import PROVIDER_KINDS, Kind
from mpsfm_core.support.files import write_file

_TEMPLATES = Path(__file__).parent / "templates"
_COMMON_FILES = ("pyproject.toml", "README.md", "tests/test_contract.py")
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def write_plugin(name: str, kind: Kind, folder: Path) -> list[Path]:
    """Write a new plugin package whose provider or hooks pass the contract checks.

    Args:
        name: Name of the Python package, the distribution and the provider.
        kind: Kind of the provider, such as ``depth``, or ``hook`` for a plugin with hooks and
            without providers.
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
    description = PROVIDER_KINDS.get(kind)
    packages: tuple[str, ...] = ("mpsfm-core>=0.1",)
    if description is not None:
        packages += ("numpy>=1.26", *description.template_requirements)
    placeholders = {
        "name": name,
        "module": module,
        "Class": "".join(part.capitalize() for part in name.split("-")),
        "kind": kind,
        "dependencies": ", ".join(f'"{package}"' for package in packages),
    }
    templates = _read_templates(kind)
    usage = templates.pop("usage.yaml", "")
    placeholders["usage"] = Template(usage).substitute(placeholders).strip()
    row = f"| `{module}/contract.py` | how the contract is checked without weights |\n"
    placeholders["contract_row"] = row if "contract.py" in templates else ""
    sources = {}
    for file_name in _COMMON_FILES:
        common = (_TEMPLATES / "common" / file_name).read_text(encoding="utf-8")
        sources[target / file_name] = templates.pop(Path(file_name).name, common)
    sources |= {target / module / name: text for name, text in templates.items()}
    texts = {path: Template(text).substitute(placeholders) for path, text in sources.items()}
    texts[target / module / "__init__.py"] = ""
    for path, text in texts.items():
        write_file(path, text)
    return sorted(texts)


def _read_templates(kind: Kind) -> dict[str, str]:
    """Return the texts of the template files of a provider kind or of hooks by file name."""
    if kind in PROVIDER_KINDS and PROVIDER_KINDS[kind].template:
        return dict(PROVIDER_KINDS[kind].template)
    files = (_TEMPLATES / kind).glob("*.*")
    return {file.name: file.read_text(encoding="utf-8") for file in files}
