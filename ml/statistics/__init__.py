"""Statistics of sessions and visits: controllers against cDBS, non-inferiority, planning, pooling, bootstraps that keep sessions whole."""
