"""C# without an SDK: a compiler, two runtimes and a runner of NUnit tests for the headset apps.

python -m tools.csharp test             # builds what has no engine, runs its tests on .NET and on Mono
python -m tools.csharp run PROGRAM ...  # one of tools/csharp/programs
"""
