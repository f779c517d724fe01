"""Tables: steps of 2 s, raw LFP, minutes of tremor, grasp tests."""
