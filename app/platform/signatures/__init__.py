"""Electronic signatures: who signed what, when, with which meaning. `app.accounts.signing.sign` asks for the password and makes one."""
