"""`packuv serve`: a dashboard that stays, runs by a form, and runs on a schedule."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from pipelines.server import DATABASE, QUIET, Server, named_server, override, own_home, running_server, serving


def serve(arguments: argparse.Namespace) -> int:
    """`packuv serve`: until Ctrl-C or SIGTERM."""
    out, data = Path(os.path.abspath(arguments.out)), arguments.data
    if data and not data.exists():
        raise FileNotFoundError(f"no manifest or folder of captures {data}; name one that is there with --data")
    out.mkdir(parents=True, exist_ok=True)
    with _server(out, arguments.host, arguments.port) as server:
        from pipelines.deploy import ServeOptions, serve_deployments  # takes seconds, in which the server starts

        options = ServeOptions(
            out=out,
            data=data and Path(os.path.abspath(data)),
            cron=arguments.cron,
            timezone=arguments.timezone,
            preset=arguments.preset,
            at_once=arguments.at_once,
        )
        server.wait_ready()
        print(f"dashboard  {server.dashboard}")
        print(f"results    {out}; packuv run --out {arguments.out} shows up there, too")
        print(f"schedule   {options.cron or 'none'}", flush=True)
        serve_deployments(options)
    return 0


@contextlib.contextmanager
def _server(out: Path, host: str, port: int) -> Iterator[Server]:
    """The user's own server, or one that keeps its database under the output folder."""
    with override(QUIET, keep=True):
        if named := named_server():
            with override({"PREFECT_API_URL": named.address}), serving(out, named.address):
                yield named
            return
        with own_home(out, "serve") as (home, lock):
            database = home / DATABASE
            with (
                running_server(
                    home, lock, out, database=database, settings={"PREFECT__SERVER_FINAL": "1"}, host=host, port=port
                ) as server,
                serving(out, server.address),
            ):
                yield server
