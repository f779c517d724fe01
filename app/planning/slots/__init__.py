"""Back into the record: the sessions of a visit in the slots of its plan, planned against done."""
