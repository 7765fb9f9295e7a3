"""Valid instances of unusual kinds, which no test set contains."""

from mtsp_env import Instance

ODD = {
    "one city": Instance([[0.5, 0.5], [0.5, 1.0]], n_agents=2),
    "one city, one agent": Instance([[0.5, 0.5], [0.5, 1.0]], n_agents=1),
    "one agent": Instance([[0.5, 0.5], [0.5, 1.0], [1.0, 0.5], [0.0, 0.5]], n_agents=1),
    "more agents than cities": Instance([[0.5, 0.5], [0.5, 1.0], [1.0, 0.5]], n_agents=5),
    "coincident cities": Instance([[0.5, 0.5], [0.1, 0.1], [0.1, 0.1], [0.1, 0.1], [0.9, 0.9]], n_agents=2),
    "cities on the depot": Instance([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5], [0.9, 0.9]], n_agents=2),
    "all in one place": Instance([[0.5, 0.5]] * 4, n_agents=2),
    "all in one place, one agent": Instance([[0.5, 0.5]] * 4, n_agents=1),
}
