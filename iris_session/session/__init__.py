"""A running session: `Session` and `ScenePublisher`, their step loop, core, processes, supervision and resume.

`core` composes authority, control and physics into one pure function; `stepper` feeds it and sends its results out;
`processes` starts front and recorder. Not here: what the front does (`front`), demos (`demo`), clients (`client`).
"""
