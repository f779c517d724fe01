"""Support of a policy by the logged data, tested before any estimate is made."""
