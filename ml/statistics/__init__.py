"""Statistics of sessions: rank-sum tests between controllers and bootstraps that keep sessions whole."""
