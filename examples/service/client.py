"""Replans a team that is already under way, by asking the service.

mtsp serve                            # in one terminal
python examples/service/client.py     # in another
"""

import json
import sys
import urllib.error
import urllib.request

URL = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"

request = {
    "nodes": [
        [0, 0],
        [40, 10],
        [35, 60],
        [-20, 45],
        [-50, 5],
        [-30, -40],
        [15, -55],
        [60, -20],
    ],  # metres; the depot first
    "n_agents": 3,
    # Agent 0 has visited city 1 and is on its way to city 2, agent 1 is on its way to city 4, agent 2 is at the depot.
    "prefixes": [[0, 1, 2], [0, 4], [0]],
    "seconds": 0.2,
}


def ask(request: dict) -> dict:
    """The answer of the service; RuntimeError with its reason if it refuses."""
    body = json.dumps(request).encode()
    post = urllib.request.Request(f"{URL}/solve", body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(post, timeout=request["seconds"] + 5) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as refusal:  # 503: busy, try again after the seconds in the header Retry-After
        raise RuntimeError(f"{refusal.code}: {json.load(refusal)['detail']}") from refusal


answer = ask(request)
for agent, (tour, length) in enumerate(zip(answer["tours"], answer["lengths"], strict=True)):
    print(f"agent {agent}: {tour}, {length:.1f} m")
print(f"makespan {answer['makespan']:.1f} m after {answer['seconds']:.3f} s")
