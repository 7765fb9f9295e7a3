"""Measures the service: requests per second, how long answers take, and how many are late or refused.

mtsp serve                                                         # in one terminal
python examples/service/load.py --nodes 50 --concurrency 16        # in another; needs httpx

Each of the clients sends its next request as soon as it has the answer to the one before.
"""

import argparse
import asyncio
import json
import random
import time
from collections import Counter
from collections.abc import Iterator

import httpx

parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
parser.add_argument("--url", default="http://127.0.0.1:8000")
parser.add_argument("--nodes", type=int, default=50)
parser.add_argument("--agents", type=int, default=5)
parser.add_argument("--requests", type=int, default=500)
parser.add_argument("--concurrency", type=int, default=16)
parser.add_argument("--seconds", type=float, default=1.0, help="deadline of each request")
parser.add_argument("--method", default="reference", choices=["reference", "dan"])
options = parser.parse_args()


async def run_client(client: httpx.AsyncClient, numbers: Iterator[int], answers: list) -> None:
    for number in numbers:
        draw = random.Random(number)
        nodes = [[draw.random(), draw.random()] for _ in range(options.nodes)]
        request = {"nodes": nodes, "n_agents": options.agents, "seconds": options.seconds, "method": options.method}
        start = time.perf_counter()
        answer = await client.post(f"{options.url}/solve", json=request)
        answers.append((answer.status_code, time.perf_counter() - start, answer.json()))


async def main() -> None:
    limits = httpx.Limits(max_connections=options.concurrency)
    answers: list = []
    numbers = iter(range(options.requests))
    async with httpx.AsyncClient(limits=limits, timeout=options.seconds + 30) as client:
        start = time.perf_counter()
        await asyncio.gather(*(run_client(client, numbers, answers) for _ in range(options.concurrency)))
        seconds = time.perf_counter() - start
    times = sorted(took for code, took, _ in answers if code == 200)
    tours = [answer for code, _, answer in answers if code == 200]
    own_times = sorted(answer["seconds"] for answer in tours)  # from the request's arrival to the answer's departure
    report = {
        "nodes": options.nodes,
        "concurrency": options.concurrency,
        "deadline_s": options.seconds,
        "answers_per_s": round(len(times) / seconds, 1),
        "p50_s": round(times[len(times) // 2], 3),
        "p99_s": round(times[len(times) * 99 // 100], 3),
        "longest_s": round(times[-1], 3),
        "service_p99_s": round(own_times[len(times) * 99 // 100], 3),
        "late": sum(took > options.seconds for took in times),
        "codes": dict(Counter(code for code, _, _ in answers)),
        "mean_makespan": round(sum(answer["makespan"] for answer in tours) / len(tours), 4),
    }
    print(json.dumps(report))


asyncio.run(main())
