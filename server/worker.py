"""One worker of a service: a process of its own around the listening socket of all; started by `workers`.

Its orders come on standard input, a line each: how to serve, then where the others stand. The end of that
input means that nobody watches over it any more: it drains and stops.
"""

from __future__ import annotations

import os
import signal
import socket
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from threading import Thread

from pydantic import TypeAdapter

from command import command
from models import BundleError
from monitor import MonitorError
from recorder import RecordingError
from server.alarms import AlarmsError
from server.crew import Crew, Roster
from server.serve import Place, ServeConfig, ServeError, serve


@dataclass(frozen=True)
class Order:
    """How a worker serves. What all workers must share and no file holds is handed on here.

    Attributes:
        config: the service's settings, this worker's part of them.
        number: the worker's, from 1.
        listener: the descriptor of the listening socket, which it inherits.
        places: the sockets at which the workers talk to each other, in order.
        memory_key: the key that all of them seal memories with, in hexadecimal digits.
    """

    config: ServeConfig
    number: int
    listener: int
    places: list[Path]
    memory_key: str


ORDER = TypeAdapter(Order)
ROSTER = TypeAdapter(Roster)


def _follow(orders: FileIO, crew: Crew) -> None:
    while line := orders.readline():
        crew.roster = ROSTER.validate_json(line)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    """Entry point of a worker; its one line on standard output says that it listens."""
    # Without a buffer: a thread that waits in one would hold up the interpreter's end.
    orders = FileIO(0)
    order = ORDER.validate_json(orders.readline())
    crew = Crew(order.number, order.places)
    Thread(target=_follow, args=(orders, crew), daemon=True).start()
    with command("lagnet-serve", ServeError, AlarmsError, BundleError, MonitorError, RecordingError):
        listener = socket.socket(fileno=order.listener)
        serve(order.config, Place(crew, listener, bytes.fromhex(order.memory_key)))


if __name__ == "__main__":
    main()
