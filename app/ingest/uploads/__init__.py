"""Uploads: receiving files, removing identity, decoding, and making sessions of what came."""
