"""Phase I, collect: uploads, decoding and the sessions that come out."""
