"""Sign-on at a hospital's identity provider (OpenID Connect), in addition to passwords: the provider confirms who a user is, never what
they may."""
