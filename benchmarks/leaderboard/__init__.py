"""The leaderboard: tours that anybody submits for the named test sets, judged here beside this project's own rows."""
