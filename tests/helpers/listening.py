"""Where a process listens, by Linux's tables of sockets."""

import os
from pathlib import Path


def sockets(pid="self"):
    """Inodes of the sockets that a process holds."""
    links = [link for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink() and link.exists()]
    return {os.readlink(link) for link in links}


def listening(*pids, port=None):
    """Addresses, in the kernel's hexadecimal, on which these processes listen, or on which anybody does at a port."""
    held = set().union(*map(sockets, pids)) if pids else None
    found = []
    for table in ("tcp", "tcp6"):
        for row in map(str.split, Path(f"/proc/net/{table}").read_text().splitlines()[1:]):
            address, _, there = row[1].rpartition(":")
            mine = held is None or f"socket:[{row[9]}]" in held
            if row[3] == "0A" and mine and port in (None, int(there, 16)):
                found.append(address)
    return found
