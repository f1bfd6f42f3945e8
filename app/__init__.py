"""Orchestration and delivery: the command line, the service, jobs; the only place that knows everything."""
