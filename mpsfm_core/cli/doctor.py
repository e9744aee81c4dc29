"""``mpsfm doctor``: check the installation and suggest improvements."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mpsfm_core.cli.arguments import ConfigName, Offline, config_overrides
from mpsfm_core.cli.models import CacheDir

if TYPE_CHECKING:
    from mpsfm_core.pipeline.provider_resolution import ProviderResolution
    from mpsfm_core.providers.registry import Registry


def doctor(
    config: ConfigName = "default",
    offline: Offline = False,
    cache: CacheDir = None,
) -> None:
    """List installed plugins, the providers of a run, and how to improve runs on this machine.

    The check downloads and computes nothing. The exit code is 1 if a plugin is broken.
    """
    from mpsfm_core.cli.cache import cache_size, format_size
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.extraction.cache import cache_folder
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry, core_version
    from mpsfm_core.report.reasons import explain
    from mpsfm_core.support.threads import count_cores

    registry = Registry.discover()
    _heading("this machine")
    _line("mpsfm", f"{core_version()}, Python {platform.python_version()}, {platform.system()}")
    _line("processor", f"{count_cores()} cores{_memory()}")
    _line("GPU", _gpu())
    folder = cache_folder(cache)
    _line("cache", f"{folder}, {format_size(cache_size(folder))} (to shrink: mpsfm cache prune)")
    _heading("plugins")
    broken = _print_plugins(registry)
    _heading(f"a run with --config {config} uses")
    advice = list(_missing_plugins(registry))
    try:
        overrides = [
            *config_overrides(None, offline),
            *([f"runtime.cache_dir={cache}"] if cache else []),
        ]
        provision = preview_providers(load_config(config, overrides, registry), registry)
    except InputError as error:
        _line("nothing", str(error))
        advice.insert(0, str(error))
    else:
        for choice in provision.choices:
            download = ", to be downloaded" if choice.to_fetch else ""
            reason = explain(choice.reason.because()).text
            _line(choice.block, f"{choice.provider.name} ({reason}{download})")
        advice = [*_better_choices(provision), *advice]
    if "none" in _gpu():
        advice.append("a GPU with CUDA makes networks and dense matching many times faster")
    _heading("how to improve runs on this machine")
    for text in dict.fromkeys(advice) or ["no suggestions"]:
        typer.echo(f"  - {text}")
    if broken:
        raise typer.Exit(1)


def _print_plugins(registry: Registry) -> bool:
    """Print a line per installed plugin package; return True if a plugin is broken."""
    status = registry.status()
    usable = Counter(line.distribution for line in status if line.available)
    versions = {line.distribution: line.version for line in status}
    faults = [line for line in status if not line.available]
    for name, version in sorted(versions.items()):
        count = usable[name]
        num_faults = sum(line.distribution == name for line in faults)
        unavailable = f", {num_faults} unavailable" if num_faults else ""
        _line(name, f"{version}, {count} providers and hooks available{unavailable}")
    for line in faults:
        _line("", f"{line.kind} {line.name} {line.reason}; {line.install_hint}".rstrip("; "))
    return any(line.kind == "plugin" for line in faults)


def _missing_plugins(registry: Registry) -> Iterator[str]:
    """Yield suggestions to install missing first-party plugins."""
    from mpsfm_core.providers.first_party import PLUGIN_PROVIDERS

    installed = {line.distribution for line in registry.status()}
    for requirement, providers in PLUGIN_PROVIDERS.items():
        if requirement.partition("[")[0] not in installed:
            yield f"pip install '{requirement}' adds {', '.join(providers)}"


def _better_choices(provision: ProviderResolution) -> Iterator[str]:
    """Yield suggestions to make preferred but unavailable providers available."""
    from mpsfm_core.report.reasons import explain

    for choice in provision.choices:
        for name, why in choice.passed_over.items():
            yield f"{choice.block}: {name} would be better: {explain(why).text}"
        for file in choice.to_fetch:
            yield f"mpsfm models fetch {choice.provider.name} downloads {file.uri} in advance"


def _gpu() -> str:
    """Describe the GPUs of the machine; the text contains "none" without a usable GPU."""
    if shutil.which("nvidia-smi") is None:
        return "none with CUDA: networks run on the processor"
    query = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
    try:
        output = subprocess.run(query, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        return f"none usable: {error}"
    return "; ".join(output.stdout.strip().splitlines()) or "none"


def _memory() -> str:
    """Describe the memory of the machine as text; empty if unknown."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
    except OSError:
        return ""
    kilobytes = next(int(line.split()[1]) for line in text.splitlines() if "MemTotal" in line)
    return f", {kilobytes / 2**20:.0f} GB memory"


def _heading(text: str) -> None:
    typer.secho(text, bold=True)


def _line(name: str, text: str) -> None:
    typer.echo(f"  {name:<24}{text}")
