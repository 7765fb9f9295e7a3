"""Near-optimal tours in milliseconds to seconds, to measure regret against and to learn from (extra ``reference``).

>>> tours = improve(uniform(np.random.default_rng(0), n_nodes=50, n_agents=5), seconds=0.005)

A ruin-and-recreate local search that starts from greedy insertion or from given tours. ``solver`` and ``choices`` hold
the public functions, ``annealing`` the search, ``search`` its arrays, ``sisr`` the compiled kernels. Numba compiles the
kernels at first use, once per machine, and caches them on disk (``__pycache__``, or ``NUMBA_CACHE_DIR``).
"""

try:
    import numba  # noqa: F401
    import scipy  # noqa: F401
except ModuleNotFoundError as error:
    if error.name not in ("numba", "scipy"):
        raise
    raise ModuleNotFoundError(
        f"mtsp_env.reference needs {error.name}: pip install 'mtsp-env[reference]'", name=error.name
    ) from error

from mtsp_env.reference.choices import tours_after
from mtsp_env.reference.solver import compile_kernels, improve, improve_batch, plan_rest

__all__ = ["compile_kernels", "improve", "improve_batch", "plan_rest", "tours_after"]
