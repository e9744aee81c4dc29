"""Reading and writing of YAML 1.2, with errors for repeated keys, and line numbers.

PyYAML itself follows YAML 1.1, where ``no`` is false, ``1e-3`` a text and ``2024-01-01`` a date.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

from mpsfm_core.data.errors import ConfigError

_SCALARS = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf)|\.(nan|NaN)",
        list("-+.0123456789"),
    ),
)


class _Loader(yaml.SafeLoader):
    """Loader of YAML 1.2 scalars that rejects repeated keys."""

    yaml_implicit_resolvers = {}  # noqa: RUF012  (class attribute of PyYAML)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for position, key in enumerate(keys):
            if key in keys[:position]:
                mark = node.value[position][0].start_mark
                raise yaml.MarkedYAMLError(problem=f"key {key!r} repeated", problem_mark=mark)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Dumper of YAML 1.2 scalars; repeated objects are written in full instead of as aliases."""

    yaml_implicit_resolvers = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern, _first in _SCALARS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_name}", re.compile(f"^(?:{_pattern})$"), _first
        )


def parse_yaml(text: str, source: str) -> Any:
    """Parse a YAML document.

    Args:
        text: Text of the YAML document.
        source: Source of the document for error messages, a file name or a command-line option.

    Raises:
        ConfigError: the document is not valid YAML; the error message has source and line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{source}{line}: the text is not valid YAML: {error.problem}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{source}: the text is not valid YAML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{source}: the YAML text is nested too deeply") from error


def parse_assignment(text: str) -> dict[str, Any]:
    """Parse ``a.b=value`` with a YAML value to ``{"a": {"b": value}}``.

    Raises:
        ConfigError: the text is no assignment ``a.b=value``, or its value is not valid YAML.
    """
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    source = f"--set {text}"
    if not (equals and all(parts)):
        raise ConfigError(f"{source}: a setting must look like a.b=value")
    data: Any = parse_yaml(value, source)
    for part in reversed(parts):
        data = {part: data}
    return dict(data)


def write_yaml(value: Any) -> str:
    """Format plain data as block-style YAML; inverse of :func:`parse_yaml`."""
    text: str = yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    return text


def find_line(text: str, path: tuple[str | int, ...]) -> int | None:
    """Find the line number (from 1) of the setting at a path of a YAML text, or None."""
    node = yaml.compose(text, Loader=_Loader)
    line = None
    for part in path:
        if isinstance(node, yaml.MappingNode):
            entries = [(key.start_mark, v) for key, v in node.value if key.value == str(part)]
        elif isinstance(node, yaml.SequenceNode) and str(part).isdigit():
            entries = [(v.start_mark, v) for v in node.value[int(part) : int(part) + 1]]
        else:
            return None
        if not entries:
            return None
        mark, node = entries[0]
        line = mark.line + 1
    return line
