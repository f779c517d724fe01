"""QoCs from uploaded files: minutes of tremor and grasp tests."""
