"""Jobs: the pure state machine, the runner, the order of levels, one level's captures, its pictures."""
