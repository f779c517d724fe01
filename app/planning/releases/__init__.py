"""Release of a policy for testing in participants: signed by a clinician over its bytes, where it comes from, and its limits."""
