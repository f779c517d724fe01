"""Physiology of the detailed synthetic participants: beta activity, medication, symptoms."""
