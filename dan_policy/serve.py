"""The command ``mtsp serve``. Serving imports FastAPI, Numba and, with a policy, torch; this module does not."""

from __future__ import annotations

from typing import Annotated

from dan_policy.arguments import SECONDS, arg, check_docstrings, check_working_directory, default, whole

KEEP_ALIVE_SECONDS = 75  # after uvicorn's 5, a slow client would send its next request to a connection just closed


def serve(
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, whole(1, "PORT")] = 8000,
    policy: Annotated[str | None, arg(metavar="NAME|FILE"), default("the reference solver alone")] = None,
    processes: Annotated[int, whole(1, "K")] = 2,
    max_nodes: Annotated[int, whole(2, "N")] = 1000,
    max_agents: Annotated[int, whole(1, "M")] = 200,
    max_seconds: Annotated[float, SECONDS] = 10.0,
    max_waiting: Annotated[int, whole(1, "K")] = 128,
) -> None:
    """Answer requests to plan and to replan over HTTP.

    examples:
      mtsp serve                                    (on this machine only; the page /docs describes the requests)
      mtsp serve --policy default --processes 4       (also plans with the shipped policy)
      curl -H 'Content-Type: application/json' localhost:8000/solve \\
        -d '{"nodes": [[0, 0], [3, 4], [6, 8]], "n_agents": 2, "seconds": 0.1}'

    Args:
        host: where to listen; everybody who reaches the address may use the service
        port: where to listen
        policy: a shipped model, or a file that `dan_policy.save` wrote, for requests with the method dan
        processes: plans at the same time, each in a process of its own
        max_nodes: largest instance, the depot included
        max_agents: most agents
        max_seconds: longest deadline that a request may set
        max_waiting: most requests that wait or are planned at the same time
    """
    check_working_directory()
    if policy is not None:
        check_docstrings()
    if port > 65535:
        raise ValueError(f"--port: must be at most 65535, got {port}")
    try:
        import uvicorn

        from dan_policy.service import Limits, create_app
        from dan_policy.workers import Method, Workers
    except ImportError as error:
        raise ImportError(
            f'the service needs FastAPI, uvicorn and Numba ({error}): pip install "mtsp-env[serve]"'
        ) from error
    limits = Limits(max_nodes, max_agents, max_seconds, max_waiting, processes)
    workers = Workers(processes, policy)
    methods: tuple[Method, ...] = ("reference",) if policy is None else ("reference", "dan")
    app = create_app(limits, workers, methods)
    try:
        uvicorn.run(
            app,
            host=host,
            port=port,
            access_log=False,
            limit_concurrency=2 * max_waiting + 64,  # also of connections that have sent nothing, and are in no queue
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
        )
    finally:
        workers.close()
