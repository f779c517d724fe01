"""What the logged data can say about a policy, before any estimate is made."""
