"""Runs a program under the system call filter of a systemd unit, without systemd.

Usage: filtered.py UNIT PROGRAM ARGUMENTS...

Takes the unit's SystemCallFilter=, SystemCallErrorNumber= and MemoryDenyWriteExecute=, with the groups of calls that
`systemd-analyze syscall-filter` lists, and gives up root.
"""

import errno
import mmap
import os
import pathlib
import subprocess
import sys

import pyseccomp

NOBODY = 65534


def group(name):
    """The calls of a group such as @system-service."""
    listed = subprocess.run(["systemd-analyze", "--no-pager", "syscall-filter", name], capture_output=True, text=True,
                            check=True).stdout
    return calls(line.strip() for line in listed.splitlines()[1:] if not line.strip().startswith("#"))


def calls(names):
    return {call for name in names for call in (group(name) if name.startswith("@") else [name])}


def main():
    unit, *command = sys.argv[1:]
    settings = [line.split("=", 1) for line in pathlib.Path(unit).read_text().splitlines() if "=" in line]
    allowed = set()
    for value in [value for name, value in settings if name == "SystemCallFilter"]:
        listed = calls(value.removeprefix("~").split())
        allowed = allowed - listed if value.startswith("~") else allowed | listed
    denied = pyseccomp.ERRNO(getattr(errno, dict(settings)["SystemCallErrorNumber"]))
    rules = pyseccomp.SyscallFilter(denied)
    if dict(settings).get("MemoryDenyWriteExecute") == "yes":
        # Allowed unless the memory is writable and executable, or becomes executable later.
        both = mmap.PROT_WRITE | mmap.PROT_EXEC
        for call, bits in [("mmap", both), ("mprotect", mmap.PROT_EXEC), ("pkey_mprotect", mmap.PROT_EXEC)]:
            allowed.discard(call)
            for wanted in range(bits + 1):
                if wanted & bits == wanted and wanted != bits:
                    rules.add_rule(pyseccomp.ALLOW, call, pyseccomp.Arg(2, pyseccomp.MASKED_EQ, bits, wanted))
    for call in sorted(allowed):
        try:
            rules.add_rule(pyseccomp.ALLOW, call)
        except (ValueError, OSError):
            # This processor has no call of that name.
            pass
    if os.getuid() == 0:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
    rules.load()
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
