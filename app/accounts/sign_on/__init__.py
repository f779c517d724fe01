"""Sign-on at a hospital's identity provider (OpenID Connect), beside passwords: the provider says who somebody is, never what they may."""
