"""The memory that a process has allocated, and its part of shared memory: unlike PSS, no other process changes it."""

from pathlib import Path


def own_mb(pid: int) -> float:
    """Return the process's own memory in MB; 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith(("Anonymous:", "Pss_Shmem:"))) / 1024
