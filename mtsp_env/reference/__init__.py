"""Near-optimal tours in milliseconds to seconds, to measure regret against and to learn from (extra ``reference``).

>>> tours = improve(uniform(np.random.default_rng(0), n_nodes=50, n_agents=5), seconds=0.005)

A ruin-and-recreate local search from greedy insertion or from given tours: ``solver`` is what is called, ``search`` the
arrays of a search, ``sisr`` its compiled kernels. Numba compiles them when they are first needed, once per machine, and
keeps them on disk (``__pycache__``, or ``NUMBA_CACHE_DIR``).
"""

try:
    import numba  # noqa: F401
except ModuleNotFoundError as error:
    if error.name != "numba":
        raise
    raise ModuleNotFoundError(
        "mtsp_env.reference needs Numba: pip install 'mtsp-env[reference]'", name="numba"
    ) from error

from mtsp_env.reference.solver import compile_kernels, improve, improve_batch

__all__ = ["compile_kernels", "improve", "improve_batch"]
