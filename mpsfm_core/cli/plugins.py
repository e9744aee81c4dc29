"""``mpsfm plugins``: list and check plugins, and create a new one."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mpsfm_core.cli.check_log import CheckLog
from mpsfm_core.cli.plugin_probe import probe_plugins
from mpsfm_core.support.child_process import subprocess_environment

if TYPE_CHECKING:
    from mpsfm_core.testing import CheckResult

_CHECKING = "MPSFM_CHECKING"
"""Environment variable of the subprocess of ``mpsfm plugins check`` with the path of its log."""

app = typer.Typer(no_args_is_help=True, help="Installed plugins and their providers.")


@app.command("list")
def list_plugins(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List all providers with distribution, licenses and availability."""
    crashing, status, messages = probe_plugins()
    if status:
        typer.echo(messages, nl=False, err=True)
    else:  # The child process failed, and this process shows the error.
        from mpsfm_core.providers.registry import Registry

        status = [asdict(line) for line in Registry.discover(without=crashing).status()]
    if as_json:
        typer.echo(json.dumps(status, indent=2, default=str))
    else:
        _print_table(status)


@app.command()
def check(
    name: Annotated[
        str, typer.Argument(help="Check a provider (onnx, depth/onnx) or a distribution.")
    ],
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set an option of the provider; replaces the options of its test network.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="CHECK", help="Run only this check; may be repeated."),
    ] = None,
    device: Annotated[str, typer.Option(help="Run on cpu or cuda.")] = "cpu",
    strict: Annotated[
        bool, typer.Option("--strict", help="Fail also if a check could not measure the provider.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Check that providers and hooks pass the contract tests; exit code 1 if one fails."""
    if _CHECKING not in os.environ:
        arguments = [name, "--device", device, *(["--json"] if as_json else [])]
        arguments += ["--strict"] if strict else []
        arguments += [part for value in options or () for part in ("--set", value)]
        arguments += [part for value in only or () for part in ("--only", value)]
        raise typer.Exit(_check_in_subprocess(name, arguments))
    from mpsfm_core.providers.registry import Registry
    from mpsfm_core.testing.contract import (
        find_plugin,
        find_providers,
        parse_check_ids,
        parse_setup,
        run_checks,
    )
    from mpsfm_core.testing.hook_checks import HOOK_CHECKS, has_hooks, run_hook_checks

    # Importing libraries creates many objects, which garbage collection would visit many times.
    gc.set_threshold(100_000, 20, 100)
    log = CheckLog(Path(os.environ[_CHECKING]))
    registry = Registry.discover(
        without=probe_plugins().crashing if log.has_crash_while_loading else set()
    )
    checked = log.checked()

    def report(result: CheckResult) -> None:
        log.finish(result)
        if not as_json:
            _print_result(result)

    plugin = find_plugin(registry, name)
    has_providers = plugin is None or not plugin.available
    check_ids = None if only is None else parse_check_ids(only, HOOK_CHECKS)
    for kind, provider in find_providers(registry, name) if has_providers else ():
        if f"{kind}/{registry.spec(kind, provider).name}" not in checked:
            run_checks(
                registry,
                kind,
                provider,
                parse_setup(options or []),
                only=check_ids,
                device=device,
                on_start=log.start,
                on_result=report,
            )
    if has_hooks(registry, name):
        setup = parse_setup(options or []) if not has_providers else None
        run_hook_checks(
            registry,
            name,
            only=check_ids,
            without=checked,
            executor=str(setup.options.get("executor", "")) if setup else "",
            on_start=log.start,
            on_result=report,
        )
    results = log.end()
    gc.freeze()  # The interpreter would collect the objects of all imported libraries at its end.
    if as_json:
        typer.echo(json.dumps([asdict(result) for result in results], indent=2))
    else:
        _print_summary(results)
    failing = ("fail", "unmeasured") if strict else ("fail",)
    if any(result.status in failing for result in results):
        raise typer.Exit(1)


def _parse_kind(text: str) -> str:
    """Return the name of a provider kind, or ``hook``, after checking it."""
    from mpsfm_core.data.errors import did_you_mean
    from mpsfm_core.providers import KINDS

    known = (*KINDS, "hook")
    if text not in known:
        raise typer.BadParameter(f"no kind {text!r}{did_you_mean(text, known)}")
    return text


@app.command()
def new(
    name: Annotated[
        str, typer.Argument(help="Name of the package and its provider, e.g. my-depth.")
    ],
    kind: Annotated[
        str,
        typer.Option(
            help="Kind of the provider: depth, normals, multiview, camera, features, matcher, "
            "retrieval, mask, wrapper; or hook, for a plugin with hooks.",
            parser=_parse_kind,
            metavar="KIND",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Create the package here.")
    ] = Path(),
) -> None:
    """Create a plugin package with a template provider that passes the contract checks."""
    from mpsfm_core.testing.scaffold import write_plugin

    for path in write_plugin(name, kind, output):
        typer.echo(path)
    typer.echo(f"next: pip install -e {output / name} && mpsfm plugins check {name}")


def _check_in_subprocess(name: str, arguments: list[str]) -> int:
    """Run the contract checks in subprocesses, which may crash; return the last exit code.

    If a provider ends the subprocess, its check fails, and the next subprocess continues with the
    next provider. If the subprocess ends before the first check, a plugin may have crashed it. The
    next subprocess then leaves out the plugins that crash.
    """
    with tempfile.TemporaryDirectory(prefix="mpsfm-check-") as folder:
        path = Path(folder, "log")
        path.touch()
        log = CheckLog(path)
        while True:
            code = _run_checking(arguments, path)
            ending = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            ended = log.fail_started(f"the check ends the process ({ending})")
            if ended is not None:
                if "--json" not in arguments:
                    _print_result(ended)
            elif code >= 0:
                return code
            elif log.has_crash_while_loading or log.results():
                from mpsfm_core.data.errors import ProviderError

                raise ProviderError(f"{name}: the process crashes outside of checks ({ending})")
            else:
                log.note_crash_while_loading()


def _run_checking(arguments: list[str], log: Path) -> int:
    """Run ``mpsfm plugins check`` in a subprocess, print its output and return its exit code.

    OpenBLAS gets one thread by default, because the arrays of the checks are small and waiting
    threads cost CPU time. Temporary files are written next to the log, so that those of a crashed
    process are removed with the log.

    Args:
        arguments: Arguments of ``mpsfm plugins check``.
        log: File with the progress of the checks.
    """
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "mpsfm_core", "plugins", "check", *arguments],
            env={
                "OPENBLAS_NUM_THREADS": "1",
                **subprocess_environment(),
                "TMPDIR": str(log.parent),
                _CHECKING: str(log),
            },
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        assert process.stdout is not None
        with process:
            for line in process.stdout:
                typer.echo(line, nl=False)
        errors.seek(0)
        typer.echo(errors.read(), nl=False, err=True)
        return process.returncode


def _print_result(result: CheckResult) -> None:
    """Print status, provider, name and time of a finished contract check."""
    around = f" around {result.around}" if result.around else ""
    line = f"{result.status:5} {result.provider}{around}: {result.id}, {result.seconds:.2f} s"
    typer.echo(f"{line}: {result.message}" if result.message else line)


def _print_summary(results: Sequence[CheckResult]) -> None:
    """Print how many checks had each outcome, and why checks were skipped or not measured."""
    for status in ("skip", "unmeasured"):
        reasons = Counter(result.message for result in results if result.status == status)
        for reason, count in reasons.most_common():
            typer.echo(f"{count} {status}: {reason}")
    counts = Counter(result.status for result in results)
    typer.echo(", ".join(f"{count} {status}" for status, count in sorted(counts.items())))


def _print_table(status: Sequence[Mapping[str, Any]]) -> None:
    from rich.text import Text

    from mpsfm_core.cli.tables import print_table

    rows = [
        (
            line["kind"],
            Text(line["name"], style="bold" if line["available"] else "dim"),
            f"{line['distribution']} {line['version']}",
            f"{line['code_license']} / {line['weights_license']}"
            if line["kind"] != "plugin"
            else "",
            ", ".join(line["capabilities"]),
            _state(line),
        )
        for line in status
    ]
    print_table(
        ("kind", "name", "distribution", "license of code / weights", "capabilities", "state"), rows
    )


def _state(line: Mapping[str, Any]) -> str:
    if line["available"]:
        return "available"
    return f"unavailable: {line['reason']}; {line['install_hint']}".rstrip("; ")
