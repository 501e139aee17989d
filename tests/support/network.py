"""A slow network between a browser and a server on this machine."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator


class SlowNetwork:
    """Hands connections on to a local port; all that comes back shares so many bits a second. `received` counts it."""

    def __init__(self, port: int, bits_per_second: float) -> None:
        self._target, self._bytes_per_second = port, bits_per_second / 8
        self._free_at, self._turn = time.monotonic(), threading.Lock()
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._door.getsockname()[1]
        self.received = 0
        self._ends: list[socket.socket] = []
        self._carriers: list[threading.Thread] = []

    def serve(self) -> None:
        with contextlib.suppress(OSError):  # the door is closed
            while True:
                caller = self._door.accept()[0]
                self._carriers.append(threading.Thread(target=self._carry, args=(caller,)))
                self._carriers[-1].start()

    def _carry(self, caller: socket.socket) -> None:
        with caller, socket.create_connection(("127.0.0.1", self._target)) as server:
            self._ends += [caller, server]
            asking = threading.Thread(target=self._hand_on, args=(caller, server, False))
            asking.start()
            self._hand_on(server, caller, True)
            asking.join()

    def _hand_on(self, source: socket.socket, target: socket.socket, paced: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                if paced:
                    self._wait(len(data))
                target.sendall(data)
        _hang_up([source, target])

    def _wait(self, size: int) -> None:
        with self._turn:
            self._free_at = max(self._free_at, time.monotonic() - 0.05) + size / self._bytes_per_second
            self.received += size
            until = self._free_at
        time.sleep(max(0.0, until - time.monotonic()))

    def close(self) -> None:
        _hang_up([self._door])
        self._door.close()
        _hang_up(self._ends)
        for carrier in self._carriers:
            carrier.join()


def _hang_up(ends: list[socket.socket]) -> None:
    for end in ends:
        with contextlib.suppress(OSError):  # the other side was quicker
            end.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def slow_network(port: int, bits_per_second: float) -> Iterator[SlowNetwork]:
    network = SlowNetwork(port, bits_per_second)
    thread = threading.Thread(target=network.serve, daemon=True)
    thread.start()
    try:
        yield network
    finally:
        network.close()
        thread.join()
