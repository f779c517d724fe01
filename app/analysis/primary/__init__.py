"""Each controller against the cDBS sessions of the same visit: primary results, sensitivity, the verdict on its locked margins."""
