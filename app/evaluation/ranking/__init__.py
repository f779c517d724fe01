"""The ranking of policies: newest evaluation, results of tested policies, staleness, REST routes and pages."""
