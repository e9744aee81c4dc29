"""``mpsfm doctor``: what is here, what is broken, and what would make runs better."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mpsfm_core.cli.arguments import ConfigName, Offline, settings
from mpsfm_core.cli.models import CacheDir
from mpsfm_core.report.reasons import explain

if TYPE_CHECKING:
    from mpsfm_core.pipeline.provider_resolution import ProviderResolution
    from mpsfm_core.providers.registry import Registry


def doctor(
    config: ConfigName = "default",
    offline: Offline = False,
    cache: CacheDir = None,
) -> None:
    """Say what is installed, what a run would take, and what would make it better here.

    It downloads and computes nothing. Exits with 1 when a plugin is broken.
    """
    from mpsfm_core.cli.cache import cache_size, size_text
    from mpsfm_core.config import load_config
    from mpsfm_core.data.errors import InputError
    from mpsfm_core.extraction.cache import cache_folder
    from mpsfm_core.pipeline.provider_resolution import preview_providers
    from mpsfm_core.providers.registry import Registry, core_version
    from mpsfm_core.support.threads import count_cores

    registry = Registry.discover()
    _heading("this machine")
    _line("mpsfm", f"{core_version()}, Python {platform.python_version()}, {platform.system()}")
    _line("processor", f"{count_cores()} cores{_memory()}")
    _line("GPU", _gpu())
    folder = cache_folder(cache)
    _line("cache", f"{folder}, {size_text(cache_size(folder))} (mpsfm cache prune makes it less)")
    _heading("plugins")
    broken = _print_plugins(registry)
    _heading(f"a run with --config {config} takes")
    advice = list(_missing_plugins(registry))
    try:
        overrides = [*settings(None, offline), *([f"runtime.cache_dir={cache}"] if cache else [])]
        provision = preview_providers(load_config(config, overrides, registry), registry)
    except InputError as error:
        _line("nothing", str(error))
        advice.insert(0, str(error))
    else:
        for choice in provision.choices:
            fetched = ", to be downloaded" if choice.to_fetch else ""
            why = explain(choice.reason.because()).text
            _line(choice.block, f"{choice.provider.name} ({why}{fetched})")
        advice = [*_better_choices(provision), *advice]
    if "none" in _gpu():
        advice.append("a GPU with CUDA makes networks and dense matching many times faster")
    _heading("what would make runs better here")
    for text in dict.fromkeys(advice) or ["nothing that mpsfm knows of"]:
        typer.echo(f"  - {text}")
    if broken:
        raise typer.Exit(1)


def _print_plugins(registry: Registry) -> bool:
    """One line a distribution; whether one is broken."""
    status = registry.status()
    usable = Counter(line.distribution for line in status if line.available)
    versions = {line.distribution: line.version for line in status}
    faults = [line for line in status if not line.available]
    for name, version in sorted(versions.items()):
        count = usable[name]
        own = [line for line in faults if line.distribution == name]
        missing = f", {len(own)} cannot be used" if own else ""
        _line(name, f"{version}, {count} providers and hooks usable{missing}")
    for line in faults:
        _line("", f"{line.kind} {line.name} {line.reason}; {line.install_hint}".rstrip("; "))
    return any(line.kind == "plugin" for line in faults)


def _missing_plugins(registry: Registry) -> Iterator[str]:
    """Our own plugins that are not installed."""
    from mpsfm_core.providers.first_party import PLUGIN_PROVIDERS

    installed = {line.distribution for line in registry.status()}
    for requirement, brings in PLUGIN_PROVIDERS.items():
        if requirement.partition("[")[0] not in installed:
            yield f"pip install '{requirement}' brings {', '.join(brings)}"


def _better_choices(provision: ProviderResolution) -> Iterator[str]:
    """What the configuration prefers, and why it cannot be had."""
    for choice in provision.choices:
        for name, why in choice.passed_over.items():
            yield f"{choice.block}: {name} would be better: {explain(why).text}"
        for file in choice.to_fetch:
            yield f"mpsfm models fetch {choice.provider.name} gets {file.uri} before a run needs it"


def _gpu() -> str:
    if shutil.which("nvidia-smi") is None:
        return "none that CUDA can use: networks run on the processor"
    asked = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        return f"none that answers: {error}"
    return "; ".join(found.stdout.strip().splitlines()) or "none"


def _memory() -> str:
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
