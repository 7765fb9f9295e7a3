"""Replanning over HTTP: an instance and the beginnings of the tours go in, whole tours come out (extra ``serve``)."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi_offline import FastAPIOffline
from pydantic import BaseModel, ConfigDict, Field
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dan_policy.queueing import Late, Overloaded, PlanQueue
from dan_policy.workers import Method, plan
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours, from_coordinates
from mtsp_env.tours import check_prefixes, check_tours, tour_lengths
from mtsp_env.version import __version__

FARTHEST = 1e12  # greatest coordinate
BODY_SECONDS = 10.0  # for a client to send its request


@dataclass(frozen=True)
class Limits:
    """What one request may ask for, and how much the service does at the same time.

    Attributes:
        nodes: largest n, the depot included.
        agents: largest m.
        seconds: longest deadline.
        waiting: requests that may wait or be planned at the same time; further ones are refused with 503.
        plans: planned at the same time.
    """

    nodes: int = 1000
    agents: int = 200
    seconds: float = 10.0
    waiting: int = 128
    plans: int = 2

    def __post_init__(self) -> None:
        for name, minimum in (("nodes", 2), ("agents", 1), ("waiting", 1), ("plans", 1)):
            check_count(name, getattr(self, name), minimum)
        check_seconds("seconds", self.seconds)

    @property
    def body(self) -> int:
        """Largest request in bytes: a node is two numbers of 25 characters, and its place in a prefix."""
        return 4096 + 96 * self.nodes + 16 * self.agents


Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST, allow_inf_nan=False)]
Position = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
EXAMPLE: dict[str, Any] = {
    "nodes": [[0, 0], [3, 4], [6, 8], [0, 5]],
    "n_agents": 2,
    "prefixes": [[0, 1], [0]],
    "seconds": 0.5,
}


class SolveRequest(BaseModel):
    """An instance, where everybody is, and how long to think."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [EXAMPLE]})

    nodes: list[Position] = Field(min_length=2, description="coordinates (x, y) in any unit; the first is the depot")
    n_agents: int = Field(ge=1, description="how many agents share the cities")
    prefixes: list[list[int]] | None = Field(
        None,
        description="the beginning of each agent's tour. [0, 3, 5]: it has visited city 3 and is at city 5 or on its "
        "way there; [0]: it has not left yet; [0, 3, 0]: it is home for good. Without: all are at the depot",
    )
    seconds: float = Field(1.0, gt=0, allow_inf_nan=False, description="deadline of the answer, from the request on")
    method: Method = Field(
        "reference",
        description="reference: the near-optimal search, for all the time there is; dan: the policy, greedy",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of the search")


class SolveResponse(BaseModel):
    """Tours that begin with the prefixes, with their lengths in the units of the request."""

    tours: list[list[int]] = Field(description="one per agent, from the depot to the depot")
    lengths: list[float] = Field(description="of the tours, the prefixes included")
    makespan: float = Field(description="the longest length")
    method: str
    seconds: float = Field(description="time from the request to the answer")


class Refusal(BaseModel):
    """Why there are no tours."""

    detail: str


Planner = Callable[[Instance, Method, float, int, "Sequence[Sequence[int]] | None"], Tours]
REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"model": Refusal, "description": meaning}
    for code, meaning in {
        400: "not JSON",
        408: "the request did not arrive in time",
        413: "the request is too large",
        415: "the request's type is not application/json",
        422: "the request is not valid; the detail names the value and the range",
        503: "the service is busy, or could not answer by the deadline; try again later, or give it more seconds",
    }.items()
}


def create_app(
    limits: Limits | None = None, planner: Planner = plan, methods: Sequence[Method] = ("reference",)
) -> FastAPI:
    """The service: ``POST /solve``, ``GET /health``, ``/openapi.json`` and ``/docs``. It keeps nothing on disk.

    Args:
        limits: by default ``Limits()``.
        planner: (instance, method, seconds, seed, prefixes) -> tours; called on ``limits.plans`` threads. By default
            it plans in this process; ``workers.Workers`` plans in others.
        methods: those that the planner knows.
    """
    limits = limits or Limits()
    queue = PlanQueue(limits.plans, limits.waiting)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        queue.close()

    # Its page /docs brings its scripts along, so that it can be read without the internet
    app = FastAPIOffline(title="mtsp-env: replanning", version=__version__, lifespan=lifespan, redoc_url=None)
    app.add_middleware(_BodyLimit, limit=limits.body)
    app.add_exception_handler(RequestValidationError, _explain)

    @app.post("/solve", responses=REFUSALS)
    async def solve(request: Request, wanted: SolveRequest) -> SolveResponse:
        """Plan the remaining tours, and answer within ``seconds``."""
        arrived = request.scope["arrived"]
        try:
            instance = _check(wanted, limits, methods)
        except ValueError as error:
            raise HTTPException(422, str(error)) from error

        def plan_now(seconds: float) -> Tours:
            return planner(instance, wanted.method, seconds, wanted.seed, wanted.prefixes)

        try:
            tours = await queue.run(plan_now, arrived + wanted.seconds)
        except Overloaded:
            raise _busy(f"{limits.waiting} requests are waiting already") from None
        except Late:
            raise _busy(f"no answer within {wanted.seconds:g} s; {queue.size} other requests are waiting") from None
        check_tours(instance, tours)
        lengths = (tour_lengths(instance, tours) * instance.scale).tolist()
        return SolveResponse(
            tours=tours,
            lengths=lengths,
            makespan=max(lengths),
            method=wanted.method,
            seconds=time.monotonic() - arrived,
        )

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """Whether the service runs, and how busy it is."""
        return {"status": "ok", "version": __version__, "waiting": queue.size, "capacity": limits.waiting}

    return app


def _check(wanted: SolveRequest, limits: Limits, methods: Sequence[Method]) -> Instance:
    """The instance of a request within the limits; everything else is a ValueError."""
    counts = {"n_nodes": (len(wanted.nodes), limits.nodes), "n_agents": (wanted.n_agents, limits.agents)}
    for name, (count, most) in counts.items():
        if count > most:
            raise ValueError(f"{name} must be at most {most} here, got {count}")
    if wanted.seconds > limits.seconds:
        raise ValueError(f"seconds must be at most {limits.seconds:g} here, got {wanted.seconds:g}")
    if wanted.method not in methods:
        raise ValueError(f"method must be one of {list(methods)} here, got {wanted.method!r}; see mtsp serve --policy")
    instance = from_coordinates(wanted.nodes, wanted.n_agents)
    if wanted.prefixes is not None:
        check_prefixes(instance, wanted.prefixes)
    return instance


def _busy(detail: str) -> HTTPException:
    return HTTPException(503, detail, headers={"Retry-After": "1"})


async def _explain(request: Request, error: Exception) -> JSONResponse:
    """One line instead of pydantic's list: the first thing that is wrong, and where."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        return JSONResponse({"detail": f"not JSON: {first.get('ctx', {}).get('error', first['msg'])}"}, 400)
    where = ".".join(str(part) for part in first["loc"] if part != "body")
    return JSONResponse({"detail": f"{where}: {first['msg']}" if where else first["msg"]}, 422)


class _BodyLimit:
    """Reads a request's body up to a limit and for a limited time, and notes when it has arrived."""

    def __init__(self, app: ASGIApp, limit: int):
        self.app, self.limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "POST":
            await self.app(scope, receive, send)
            return
        try:
            body = await asyncio.wait_for(self._read(scope, receive), BODY_SECONDS)
        except HTTPException as refusal:
            answer = JSONResponse({"detail": refusal.detail}, refusal.status_code, {"Connection": "close"})
            await answer(scope, receive, send)
            return
        except asyncio.TimeoutError:
            answer = JSONResponse({"detail": "the request did not arrive in time"}, 408, {"Connection": "close"})
            await answer(scope, receive, send)
            return
        if body is None:  # the client has gone
            return
        scope["arrived"] = time.monotonic()
        unread = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return unread.pop() if unread else await receive()

        await self.app(scope, replay, send)

    async def _read(self, scope: Scope, receive: Receive) -> bytes | None:
        headers = dict(scope["headers"])
        kind = headers.get(b"content-type", b"").partition(b";")[0].strip().lower()
        if kind != b"application/json":
            raise HTTPException(415, f"expected the type application/json, got {kind.decode('latin-1')!r}")
        too_large = HTTPException(413, f"a request may have {self.limit} bytes here")
        if int(headers.get(b"content-length", b"0")) > self.limit:
            raise too_large
        body = bytearray()
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            body += message.get("body", b"")
            if len(body) > self.limit:
                raise too_large
            if not message.get("more_body"):
                return bytes(body)
