"""Methods of evaluation over seeds on one buffer snapshot, against what the policies returned afterwards."""
