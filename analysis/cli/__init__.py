"""The command `analyze`: `app` parses options, the other modules run the commands.

`sessions` analyses files one by one, `campaign` several together, `exchange` imports and exports.
They print and return exit codes; what they print is made by `analysis.report`.
"""
