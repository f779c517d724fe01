"""What policies would have asked for on a recorded session's beta, beside each other. No forecast: under them beta would have differed."""
