"""Lightning's ``ddp`` on one machine: its processes meet on the loopback interface, which no other machine reaches.

Torch's own meeting point listens on all interfaces, whatever address it is given, and whoever reaches it can take part
in the exchange. Processes of ``torchrun`` do meet over the network, as it brings a meeting point of its own.
"""

import atexit
import os
import socket
import sys
from datetime import timedelta

import torch.distributed as dist
from lightning.pytorch.strategies import DDPStrategy

LOOPBACK = "127.0.0.1"
_INTERFACE = "lo0" if sys.platform == "darwin" else "lo"
_PATIENCE = timedelta(minutes=30)


class LoopbackDDP(DDPStrategy):
    """``ddp`` whose processes listen to this machine alone."""

    def setup_distributed(self) -> None:
        """Join the other processes."""
        self.set_world_ranks()
        if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
            assert self.cluster_environment is not None
            for backend in ("GLOO", "NCCL"):
                os.environ.setdefault(f"{backend}_SOCKET_IFNAME", _INTERFACE)
            _join(
                self._get_process_group_backend(),
                self.cluster_environment.global_rank(),
                self.cluster_environment.world_size(),
                self.cluster_environment.main_port,
                self._timeout or _PATIENCE,
            )
        super().setup_distributed()  # which joins nobody where that is done
        atexit.register(_leave)


def _join(backend: str, rank: int, size: int, port: int, patience: timedelta) -> None:
    if dist.is_initialized():
        return
    first = rank == 0
    listener = socket.create_server((LOOPBACK, port)) if first else None
    store = dist.TCPStore(  # type: ignore[attr-defined]
        LOOPBACK,
        port,
        size,
        is_master=first,
        timeout=patience,
        master_listen_fd=None if listener is None else listener.detach(),  # the store closes it
    )
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=patience)


def _leave() -> None:
    """Groups left to the end of a process make NCCL warn, and threads of Gloo can abort it (torch #190489)."""
    if dist.is_initialized():
        dist.destroy_process_group()
