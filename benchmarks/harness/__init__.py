"""Runs solvers on the instances of a table and appends one row of results for each pair."""
