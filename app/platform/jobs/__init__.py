"""Background jobs: durable workflows, compute steps in child processes, live progress, cancel."""
