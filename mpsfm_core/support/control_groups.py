"""CPU and memory limits of Linux control groups (containers, job schedulers)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path("/sys/fs/cgroup")
_MEMBERSHIP = Path("/proc/self/cgroup")


@dataclass(frozen=True)
class MemoryLimit:
    """Memory limit of one Linux control group, in bytes."""

    total: int
    free: int
    """Bytes that the control group may still allocate, including reclaimable file cache."""


class ControlGroups:
    """Linux control groups (versions 1 and 2) that limit this process, innermost first.

    Args:
        root: Mount point of the control group file system.
        membership: File that lists the control groups of this process.
    """

    def __init__(self, root: Path = _ROOT, membership: Path = _MEMBERSHIP) -> None:
        self._root = root
        self._membership = membership

    def cpu_quota(self) -> float | None:
        """Return the smallest CPU quota in cores, or None if no group has a quota."""
        quotas = []
        for folder in self._folders("cpu"):
            with suppress(OSError, ValueError, ZeroDivisionError):
                quota, period = _read_cpu_quota(folder)
                if quota > 0:
                    quotas.append(quota / period)
        return min(quotas, default=None)

    def memory_limits(self) -> list[MemoryLimit]:
        """Return the memory limits of all control groups with a limit."""
        limits = []
        for folder in self._folders("memory"):
            with suppress(OSError, ValueError, StopIteration):
                total = int(_read_first(folder, "memory.max", "memory.limit_in_bytes"))
                used = int(_read_first(folder, "memory.current", "memory.usage_in_bytes"))
                lines = (folder / "memory.stat").read_text().splitlines()
                file_cache = next(
                    int(x.split()[1]) for x in lines if x.startswith("inactive_file ")
                )
                limits.append(MemoryLimit(total, max(0, total - (used - file_cache))))
        return limits

    def _folders(self, controller: str) -> Iterator[Path]:
        """Yield the folders of this process's control group and its visible ancestors."""
        with suppress(OSError):
            for line in self._membership.read_text().splitlines():
                _, controllers, path = line.split(":", 2)
                if controllers and controller not in controllers.split(","):
                    continue
                root = self._root / controllers if controllers else self._root
                group = root / path.lstrip("/")
                yield group
                yield from (parent for parent in group.parents if parent.is_relative_to(root))


def _read_cpu_quota(folder: Path) -> tuple[float, float]:
    """Return CPU quota and period in microseconds; raise ValueError without a quota."""
    if (folder / "cpu.max").is_file():
        quota, period = (folder / "cpu.max").read_text().split()
        return float(quota), float(period)  # a CPU quota of "max" means no quota
    quota, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
    return float(quota), float(period)


def _read_first(folder: Path, *names: str) -> str:
    return next((folder / name).read_text() for name in names if (folder / name).is_file())
