"""Controller bundles: a policy within stated limits, approved and signed, for the tablet."""
