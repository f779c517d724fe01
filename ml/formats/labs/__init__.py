"""Common part of the recordings of any lab: times, units, names and markers that may stay, and recordings made of them."""
