"""Mixed-integer linear programs, solved by HiGHS, Gurobi or CPLEX; independent of tours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array

from benchmarks.solvers import Unavailable

GAP = 1e-7  # relative gap between incumbent and bound at which a solver may stop
FEASIBILITY = 1e-7  # by how much a solver may violate a row or the integrality of a variable


@dataclass(frozen=True)
class Variables:
    """Minimise ``cost @ v`` with ``lower <= v <= upper`` and ``v[binary]`` 0 or 1; all of shape (k,)."""

    cost: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    binary: np.ndarray


@dataclass
class Rows:
    """Constraints ``lower <= matrix @ v <= upper``, collected in blocks of rows."""

    lower: list[np.ndarray] = field(default_factory=list)
    upper: list[np.ndarray] = field(default_factory=list)
    terms: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    count: int = 0

    def add(self, lower: float | np.ndarray, upper: float | np.ndarray, count: int, *terms: tuple) -> None:
        """Add ``count`` rows, the sums of ``terms``; each term is (row within the block, column, coefficient)."""
        self.lower.append(np.broadcast_to(np.asarray(lower, float), count))
        self.upper.append(np.broadcast_to(np.asarray(upper, float), count))
        for row, column, value in terms:
            row, column, value = np.broadcast_arrays(row, column, np.asarray(value, float))
            self.terms.append((row.ravel() + self.count, column.ravel(), value.ravel()))
        self.count += count

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all rows, (rows,) each."""
        return np.concatenate(self.lower), np.concatenate(self.upper)

    def matrix(self, n_columns: int) -> csr_array:
        """The coefficients, (rows, n_columns)."""
        row, column, value = (np.concatenate(part) for part in zip(*self.terms, strict=True))
        return coo_array((value, (row, column)), shape=(self.count, n_columns)).tocsr()


class Result(NamedTuple):
    """The best ``values`` (k,), or None if there are none, and a lower ``bound`` on the cost."""

    values: np.ndarray | None
    bound: float


def _highs(variables: Variables, rows: Rows, seconds: float, seed: int, start: np.ndarray | None) -> Result:
    try:
        import highspy
    except ImportError as error:
        raise Unavailable(f"package highspy is missing ({error})") from error
    matrix = rows.matrix(len(variables.cost))
    program = highspy.HighsLp()
    program.num_row_, program.num_col_ = matrix.shape
    program.col_cost_, program.col_lower_, program.col_upper_ = variables.cost, variables.lower, variables.upper
    program.row_lower_, program.row_upper_ = rows.bounds()
    program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    program.a_matrix_.start_, program.a_matrix_.index_ = matrix.indptr, matrix.indices
    program.a_matrix_.value_ = matrix.data
    kinds = highspy.HighsVarType.kContinuous, highspy.HighsVarType.kInteger
    program.integrality_ = [kinds[binary] for binary in variables.binary.tolist()]

    solver = highspy.Highs()
    options = {
        "output_flag": False,
        "threads": 1,
        "parallel": "off",
        "random_seed": seed % 2**31,
        "time_limit": seconds,
        "mip_rel_gap": GAP,
        "mip_abs_gap": 0.0,
        "mip_feasibility_tolerance": FEASIBILITY,
        "primal_feasibility_tolerance": FEASIBILITY,
    }
    for name, value in options.items():
        solver.setOptionValue(name, value)
    solver.passModel(program)
    if start is not None:
        solution = highspy.HighsSolution()
        solution.col_value = start.tolist()
        solver.setSolution(solution)
    solver.run()
    info = solver.getInfo()
    feasible = info.primal_solution_status == highspy.SolutionStatus.kSolutionStatusFeasible
    values = np.array(solver.getSolution().col_value) if feasible else None
    return Result(values, info.mip_dual_bound)


def _by_sense(variables: Variables, rows: Rows) -> list[tuple[str, csr_array, np.ndarray]]:
    """The rows as (sense, matrix, right-hand side), for solvers without two-sided rows; senses are =, < and >."""
    matrix, (lower, upper) = rows.matrix(len(variables.cost)), rows.bounds()
    same = lower == upper
    chosen = {"=": (same, upper), "<": (~same & np.isfinite(upper), upper), ">": (~same & np.isfinite(lower), lower)}
    return [(sense, matrix[mask], side[mask]) for sense, (mask, side) in chosen.items() if mask.any()]


def _gurobi(variables: Variables, rows: Rows, seconds: float, seed: int, start: np.ndarray | None) -> Result:
    try:
        import gurobipy
    except ImportError as error:
        raise Unavailable(f"package gurobipy is missing ({error})") from error
    settings = {
        "OutputFlag": 0,
        "Threads": 1,
        "Seed": seed % 2**31,
        "TimeLimit": seconds,
        "MIPGap": GAP,
        "MIPGapAbs": 0.0,
        "FeasibilityTol": FEASIBILITY,
        "IntFeasTol": FEASIBILITY,
    }
    try:
        with gurobipy.Env(params=settings) as env, gurobipy.Model(env=env) as model:
            kinds = np.where(variables.binary, "B", "C")
            v = model.addMVar(len(kinds), variables.lower, variables.upper, variables.cost, kinds)
            for sense, matrix, side in _by_sense(variables, rows):
                model.addMConstr(matrix, v, sense, side)
            if start is not None:
                v.Start = start
            model.optimize()
            return Result(v.X if model.SolCount else None, model.ObjBound)
    except gurobipy.GurobiError as error:
        if error.errno in (gurobipy.GRB.Error.NO_LICENSE, gurobipy.GRB.Error.SIZE_LIMIT_EXCEEDED):
            raise Unavailable(f"Gurobi: {error}") from error
        raise


def _cplex(variables: Variables, rows: Rows, seconds: float, seed: int, start: np.ndarray | None) -> Result:
    try:
        import cplex
    except ImportError as error:
        raise Unavailable(f"package cplex is missing ({error})") from error
    with cplex.Cplex() as model:
        for stream in (model.set_log_stream, model.set_results_stream, model.set_warning_stream):
            stream(None)
        model.set_error_stream(None)
        settings = model.parameters
        settings.threads.set(1)
        settings.randomseed.set(seed % 2**31)
        settings.timelimit.set(seconds)
        settings.mip.tolerances.mipgap.set(GAP)
        settings.mip.tolerances.absmipgap.set(0.0)
        settings.mip.tolerances.integrality.set(FEASIBILITY)
        settings.simplex.tolerances.feasibility.set(FEASIBILITY)
        model.variables.add(
            obj=variables.cost.tolist(),
            lb=variables.lower.tolist(),
            ub=variables.upper.tolist(),
            types="".join(np.where(variables.binary, "B", "C")),
        )
        for sense, matrix, side in _by_sense(variables, rows):
            lines = np.split(matrix.indices, matrix.indptr[1:-1]), np.split(matrix.data, matrix.indptr[1:-1])
            model.linear_constraints.add(
                lin_expr=[cplex.SparsePair(i.tolist(), a.tolist()) for i, a in zip(*lines, strict=True)],
                senses={"=": "E", "<": "L", ">": "G"}[sense] * len(side),
                rhs=side.tolist(),
            )
        if start is not None:
            every = cplex.SparsePair(list(range(len(start))), start.tolist())
            model.MIP_starts.add(every, model.MIP_starts.effort_level.auto)
        try:
            model.solve()
        except cplex.exceptions.CplexSolverError as error:
            if error.args[2] == cplex.exceptions.error_codes.CPXERR_RESTRICTED_VERSION:
                raise Unavailable(f"CPLEX: {error.args[0]}") from error
            raise
        solution = model.solution
        values = np.array(solution.get_values()) if solution.is_primal_feasible() else None
        return Result(values, solution.MIP.get_best_objective())


BACKENDS: dict[str, Callable[[Variables, Rows, float, int, np.ndarray | None], Result]] = {
    "highs": _highs,
    "gurobi": _gurobi,
    "cplex": _cplex,
}


def minimise(
    variables: Variables, rows: Rows, seconds: float, seed: int, backend: str, start: np.ndarray | None = None
) -> Result:
    """Solve a program on one thread, within ``seconds``, from the feasible values ``start`` (k,) if they are given.

    Raises:
        ValueError: an unknown backend.
        Unavailable: the solver is not installed, has no licence, or its licence does not allow a program of this size.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; choose from {sorted(BACKENDS)}")
    return BACKENDS[backend](variables, rows, seconds, seed, start)
