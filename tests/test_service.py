"""The service: answers are solutions in the units of the request, in order and in time; bad requests are 4xx."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import re
import subprocess
import sys
import threading
import time
from collections import deque
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

pytest.importorskip("fastapi", reason="needs the extra serve")
pytest.importorskip("numba", reason="needs the extra serve")
httpx = pytest.importorskip("httpx", reason="sends the requests")

from command import refused  # noqa: E402
from helpers.processes import alive, children, wait_until  # noqa: E402

from dan_policy.queueing import LEAST_SECONDS, Late, PlanQueue, fair_share  # noqa: E402
from dan_policy.service import Limits, create_app  # noqa: E402
from dan_policy.workers import Workers  # noqa: E402
from mtsp_env import Instance, check_tours, reference  # noqa: E402

ROOT = Path(__file__).parent.parent
LIMITS = Limits(nodes=60, agents=8, seconds=5.0, waiting=120, plans=1)
GOOD: dict[str, Any] = {"nodes": [[0, 0], [30, 40], [-30, 40], [0, 80]], "n_agents": 2, "seconds": 5.0}


def deal(instance: Instance, method: str, seconds: float, seed: int, prefixes: Any) -> list[list[int]]:
    """A planner that takes no time: the last agent visits what is left."""
    begun = [list(prefix) for prefix in prefixes or [[0]] * instance.n_agents]
    seen = {node for prefix in begun for node in prefix}
    begun[-1] += [city for city in range(1, instance.n_nodes) if city not in seen]
    return [[*tour, 0] for tour in begun]


def exchange(app: Any, *requests: dict[str, Any]) -> list[Any]:
    """The answers to requests that are sent at the same time; each is a dict of arguments of ``httpx``'s request."""

    async def send() -> list[Any]:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://service", timeout=60) as client:
            return await asyncio.gather(*(client.request(**{"method": "POST", "url": "/solve", **r}) for r in requests))

    return asyncio.run(send())


def test_lengths_have_the_units_of_the_request() -> None:
    [answer] = exchange(create_app(LIMITS, deal), {"json": {**GOOD, "prefixes": [[0, 1], [0]]}})
    assert answer.status_code == 200
    solution = answer.json()
    assert solution["tours"] == [[0, 1, 0], [0, 2, 3, 0]]
    assert solution["lengths"] == pytest.approx([100.0, 50.0 + 50.0 + 80.0])
    assert solution["makespan"] == pytest.approx(180.0)
    assert solution["method"] == "reference" and 0 < solution["seconds"] < 5.0


@pytest.mark.slow
def test_the_reference_solver_keeps_the_prefixes() -> None:
    reference.compile_kernels()
    nodes = (100 * np.random.default_rng(0).random((20, 2))).tolist()
    prefixes = [[0, 3, 7], [0], [0, 5, 0]]
    [answer] = exchange(
        create_app(LIMITS), {"json": {"nodes": nodes, "n_agents": 3, "prefixes": prefixes, "seconds": 2}}
    )
    tours = answer.json()["tours"]
    check_tours(Instance(np.array(nodes) / 100, 3), tours)
    assert [tour[: len(prefix)] for tour, prefix in zip(tours, prefixes, strict=True)] == prefixes
    assert tours[2] == [0, 5, 0]


@pytest.mark.slow
def test_a_process_plans_with_a_shipped_policy_and_keeps_the_prefixes() -> None:
    torch = pytest.importorskip("torch", reason="needs the extra dan")
    from dan_policy import solve

    threads = torch.get_num_threads()
    workers = Workers(1, policy="default")
    try:
        instance = Instance(np.random.default_rng(0).random((12, 2)), 2)
        tours = workers(instance, "dan", 1.0, 0, [[0, 3], [0]])
    finally:
        workers.close()
        torch.set_num_threads(threads)  # the service takes one for itself
    check_tours(instance, tours)
    assert tours == solve(instance, "default", device="cpu", prefixes=[[0, 3], [0]]).tours


def test_a_hundred_requests_at_once_are_planned_in_order_and_answered() -> None:
    planned: list[int] = []

    def planner(instance: Instance, method: str, seconds: float, seed: int, prefixes: Any) -> list[list[int]]:
        planned.append(seed)
        return deal(instance, method, seconds, seed, prefixes)

    answers = exchange(create_app(LIMITS, planner), *({"json": {**GOOD, "seed": seed}} for seed in range(100)))
    assert {answer.status_code for answer in answers} == {200}
    assert planned == list(range(100))


def test_a_full_service_refuses_at_once_and_recovers() -> None:
    limits, release = Limits(waiting=3, plans=1, seconds=60.0), threading.Event()

    def planner(*arguments: Any) -> list[list[int]]:
        release.wait(60)
        return deal(*arguments)

    async def send() -> tuple[list[int], dict[str, Any], int]:
        transport = httpx.ASGITransport(create_app(limits, planner))
        async with httpx.AsyncClient(transport=transport, base_url="http://service", timeout=60) as client:
            body = {**GOOD, "seconds": 60.0}
            waiting = [asyncio.create_task(client.post("/solve", json=body)) for _ in range(3)]
            while (await client.get("/health")).json()["waiting"] < 3:
                await asyncio.sleep(0)  # let the others send
            refused_answer = await client.post("/solve", json=body)
            assert refused_answer.headers["Retry-After"] == "1"
            release.set()
            codes = [(await task).status_code for task in waiting]
            return codes, refused_answer.json(), (await client.get("/health")).json()["waiting"]

    codes, refusal, left = asyncio.run(send())
    assert codes == [200] * 3
    assert refusal == {"detail": "3 requests are waiting already"}
    assert left == 0


@pytest.mark.slow
def test_an_answer_that_is_late_is_a_503_and_keeps_its_place() -> None:
    release = threading.Event()

    async def send() -> None:
        queue = PlanQueue(threads=1, capacity=2)
        with pytest.raises(Late):
            await queue.run(lambda seconds: release.wait(60), time.monotonic() + 1.0)
        assert queue.size == 1  # it still has its thread
        release.set()
        assert await queue.run(lambda seconds: "next", time.monotonic() + 60) == "next"
        assert queue.size == 0
        queue.close()

    asyncio.run(send())


@pytest.mark.parametrize(
    ("deadlines", "threads", "share"),
    [
        ([10.0], 1, 10.0),
        ([10.0] * 4, 1, 2.5),
        ([10.0] * 4, 2, 5.0),
        ([10.0, 1.0], 1, 0.5),  # the second has to be ready within a second
        ([10.0, -1.0, 8.0], 1, 4.0),  # the second is late anyway
        ([LEAST_SECONDS / 2], 1, None),
    ],
)
def test_the_time_is_shared_so_that_all_deadlines_are_kept(deadlines: list, threads: int, share: float | None) -> None:
    assert fair_share(deque(deadlines), 0.0, threads) == share


def test_nothing_is_left_after_an_error_of_the_planner() -> None:
    def planner(*arguments: Any) -> list[list[int]]:
        raise RuntimeError("no memory left")

    app = create_app(LIMITS, planner)
    with pytest.raises(RuntimeError, match="no memory left"):
        exchange(app, {"json": GOOD})
    [health] = exchange(app, {"method": "GET", "url": "/health"})
    assert health.json()["waiting"] == 0


# Fifty bad requests: (status, part of the reason, what is sent)

HUGE = "9" * 5000
CHANGES: list[tuple[int, str, dict[str, Any]]] = [
    (422, "nodes: List should have at least 2 items", {"nodes": []}),
    (422, "nodes: List should have at least 2 items", {"nodes": [[0, 0]]}),
    (422, "nodes: Input should be a valid list", {"nodes": None}),
    (422, "nodes: Input should be a valid list", {"nodes": "berlin52"}),
    (422, "nodes: Input should be a valid list", {"nodes": {"0": [0, 0]}}),
    (422, "nodes.1: List should have at least 2 items", {"nodes": [[0, 0], [1]]}),
    (422, "nodes.1: List should have at most 2 items", {"nodes": [[0, 0], [1, 2, 3]]}),
    (422, "nodes.1: Input should be a valid list", {"nodes": [[0, 0], 5]}),
    (422, "nodes.1.0: Input should be a valid number", {"nodes": [[0, 0], ["1", 2]]}),
    (422, "nodes.1.0: Input should be a valid number", {"nodes": [[0, 0], [True, 2]]}),
    (422, "nodes.1.0: Input should be a valid number", {"nodes": [[0, 0], [None, 2]]}),
    (422, "nodes.1.0: Input should be less than or equal to", {"nodes": [[0, 0], [1e300, 2]]}),
    (422, "nodes.1.0: Input should be greater than or equal to", {"nodes": [[0, 0], [-1e13, 2]]}),
    (422, "n_nodes must be at most 60 here, got 61", {"nodes": [[0, 0]] * 61}),
    (422, "n_agents: Input should be greater than or equal to 1", {"n_agents": 0}),
    (422, "n_agents: Input should be greater than or equal to 1", {"n_agents": -3}),
    (422, "n_agents must be at most 8 here, got 9", {"n_agents": 9}),
    (422, "n_agents must be at most 8 here", {"n_agents": 10**30}),
    (422, "n_agents: Input should be a valid integer", {"n_agents": 2.5}),
    (422, "n_agents: Input should be a valid integer", {"n_agents": "2"}),
    (422, "n_agents: Input should be a valid integer", {"n_agents": None}),
    (422, "n_agents: Input should be a valid integer", {"n_agents": True}),
    (422, "seconds: Input should be greater than 0", {"seconds": 0}),
    (422, "seconds: Input should be greater than 0", {"seconds": -1}),
    (422, "seconds must be at most 5 here, got 6", {"seconds": 6}),
    (422, "seconds: Input should be a valid number", {"seconds": "soon"}),
    (422, "seconds: Input should be a valid number", {"seconds": None}),
    (422, "method: Input should be 'reference' or 'dan'", {"method": "lkh"}),
    (422, "method must be one of ['reference'] here, got 'dan'", {"method": "dan"}),
    (422, "seed: Input should be greater than or equal to 0", {"seed": -1}),
    (422, "seed: Input should be less than", {"seed": 2**63}),
    (422, "seed: Input should be a valid integer", {"seed": 1.5}),
    (422, "samples: Extra inputs are not permitted", {"samples": 64}),
    (422, "speeds: Extra inputs are not permitted", {"speeds": [1, 2]}),
    (422, "expected 2 prefixes, one per agent, got 1", {"prefixes": [[0]]}),
    (422, "prefix 0 must begin at the depot 0, got []", {"prefixes": [[], [0]]}),
    (422, "prefix 0 must begin at the depot 0, got [1]", {"prefixes": [[1], [0]]}),
    (422, "prefix 1 visits node 4, outside 0..3", {"prefixes": [[0], [0, 4]]}),
    (422, "prefix 1 visits node -1, outside 0..3", {"prefixes": [[0], [0, -1]]}),
    (422, "city 2 is in the prefixes more than once", {"prefixes": [[0, 2], [0, 2]]}),
    (422, "prefix 0 must not pass the depot in the middle", {"prefixes": [[0, 1, 0, 2], [0]]}),
    (422, "all agents are home for good, and 2 cities are left", {"prefixes": [[0, 1, 0], [0, 0]]}),
    (422, "prefixes.0.0: Input should be a valid integer", {"prefixes": [["0"], [0]]}),
    (422, "prefixes.0: Input should be a valid list", {"prefixes": [0, 0]}),
]
BODIES: list[tuple[int, str, dict[str, Any]]] = [
    (400, "not JSON", {"content": b"{"}),
    (400, "not JSON", {"content": b"nodes"}),
    (400, "", {"content": b"\xff\xfe{}"}),
    (400, "", {"content": f'{{"n_agents": {HUGE}}}'.encode()}),
    (422, "Field required", {"content": b""}),
    (422, "nodes: Field required", {"content": b"{}"}),
    (422, "Input should be a valid dictionary", {"content": b"[]"}),
    (422, "Input should be a finite number", {"content": b'{"nodes": [[0, 0], [NaN, 1]], "n_agents": 1}'}),
    (
        422,
        "Input should be a finite number",
        {"content": b'{"nodes": [[0, 0], [1, 1]], "n_agents": 1, "seconds": NaN}'},
    ),
    (413, "a request may have", {"content": b" " * (LIMITS.body + 1)}),
    (415, "expected the type application/json, got 'text/plain'", {"headers": {"Content-Type": "text/plain"}}),
    (415, "expected the type application/json, got ''", {"headers": {}}),
    (405, "Method Not Allowed", {"method": "GET"}),
    (404, "Not Found", {"url": "/nowhere"}),
]


def bad_requests() -> list:
    headers = {"Content-Type": "application/json"}
    changed = [(code, reason, {"json": {**GOOD, **change}}) for code, reason, change in CHANGES]
    bodies = [(code, why, {"headers": headers, "content": json.dumps(GOOD), **sent}) for code, why, sent in BODIES]
    return [*changed, *bodies]


def test_fifty_bad_requests_are_refused_with_the_reason() -> None:
    def planner(*arguments: Any) -> list[list[int]]:
        raise AssertionError("a bad request was planned")

    cases = bad_requests()
    assert len(cases) >= 50
    answers = exchange(create_app(LIMITS, planner), *(sent for _, _, sent in cases))
    for (code, reason, sent), answer in zip(cases, answers, strict=True):
        assert answer.status_code == code, (sent, answer.text)
        detail = answer.json()["detail"]
        assert isinstance(detail, str) and reason in detail and "\n" not in detail, (sent, detail)


def test_requests_are_described() -> None:
    [schema] = exchange(create_app(LIMITS, deal), {"method": "GET", "url": "/openapi.json"})
    described = schema.json()
    assert {"/solve", "/health"} <= described["paths"].keys()
    assert {"200", "400", "413", "415", "422", "503"} <= described["paths"]["/solve"]["post"]["responses"].keys()
    example = described["components"]["schemas"]["SolveRequest"]["examples"][0]
    [answer] = exchange(create_app(LIMITS, deal), {"json": example})
    assert answer.status_code == 200


def test_the_page_of_the_description_needs_no_internet() -> None:
    app = create_app(LIMITS, deal)
    [page] = exchange(app, {"method": "GET", "url": "/docs"})
    files = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert len(files) >= 3  # script, style and icon
    assert "://" not in page.text
    answers = exchange(app, *({"method": "GET", "url": file} for file in files))
    assert [answer.status_code for answer in answers] == [200] * len(files)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"nodes": 1}, "nodes must be"), ({"plans": 0}, "plans must"), ({"seconds": 0}, "seconds must")],
)
def test_bad_limits(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Limits(**change)


def test_bad_options_of_the_command(capsys: pytest.CaptureFixture) -> None:
    assert "--port: must be at most 65535, got 65536" in refused(capsys, "serve", "--port", "65536")
    assert "processes 1000000000 needs about" in refused(capsys, "serve", "--processes", "1000000000")
    assert "--max-nodes: must be a whole number of at least 2" in refused(capsys, "serve", "--max-nodes", "1")


@pytest.mark.slow
def test_a_plan_under_way_ends_with_a_service_that_is_killed() -> None:
    code = (
        "import numpy as np; from dan_policy.workers import Workers; from mtsp_env import uniform\n"
        "workers = Workers(1, None); print('ready', flush=True)\n"
        "workers(uniform(np.random.default_rng(0), 200, 5), 'reference', 1000.0, 0, None)"
    )
    service = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert service.stdout is not None and service.stdout.readline() == "ready\n"
    processes = [psutil.Process(pid) for pid in children(service.pid)]
    before = sum(process.cpu_times().user for process in processes)
    wait_until(lambda: sum(process.cpu_times().user for process in processes) > before + 0.5)  # the plan is under way
    service.kill()
    service.wait()
    wait_until(lambda: not any(alive(process.pid) for process in processes))


@pytest.mark.slow
def test_workers_plan_in_processes_and_outlive_a_killed_one() -> None:
    workers = Workers(1, policy=None)
    instance = Instance(np.random.default_rng(0).random((12, 2)), 3)
    try:
        begun = [[0, 4], [0], [0]]
        tours = workers(instance, "reference", 0.05, 0, begun)
        check_tours(instance, tours)
        assert tours[0][:2] == [0, 4]
        [process] = [child for child in multiprocessing.active_children() if child.is_alive()]
        process.kill()
        process.join()
        with pytest.raises(BrokenProcessPool):
            workers(instance, "reference", 0.05, 0, None)
        check_tours(instance, workers(instance, "reference", 0.05, 0, None))
    finally:
        workers.close()
