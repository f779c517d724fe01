"""Electronic signatures: who signed what, when, with which meaning. `app.accounts.sign_on.sign` asks for the password and makes one."""
