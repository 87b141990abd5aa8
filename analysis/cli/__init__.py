"""The command `analyze`: `app` parses options, the other modules run the commands.

`sessions` analyses files one by one, `campaign` analyses several together, `exchange` imports and
exports files, and `touch` estimates touches. They print texts that `analysis.report` makes, and
return exit codes.
"""
