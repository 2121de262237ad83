// A client without engine and screen: joins a session over the web wire as a headset app does, and does what it is asked to.
//
//     headless run [--address ADDRESS[,ADDRESS]] [--code CODE] [--identity FOLDER] [--name NAME] [--role ROLE] [--trust FINGERPRINT]
//                  [--json] [--do "COMMAND; COMMAND"]
//
// Without --do, commands are lines of its input; see Commands.cs. Exit status: 0 when all of them succeeded, 1 when one failed, 2 when
// no session could be joined. With --json, a line of JSON for each command.
using System;
using System.Collections.Generic;
using System.IO;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

internal static class Program
{
    private const int UsageStatus = 2;

    private static int Main(string[] arguments)
    {
        Options options = Options.Parse(arguments);
        if (options == null)
        {
            Console.Error.WriteLine("headless run [--address A] [--code C] [--identity FOLDER] [--name N] [--role R] [--trust F] [--json] [--do COMMANDS]");
            return UsageStatus;
        }
        Report report = new Report(options.IsJson);
        FileIdentityStore identity = new FileIdentityStore(options.Identity);
        WebEndpoint[] endpoints = Finder.Find(options, identity, report);
        if (endpoints == null) return UsageStatus;
        using (Headset headset = new Headset(options, identity, endpoints))
        {
            Commands commands = new Commands(headset, report, options);
            bool isDone = commands.Run(options.Do == null ? ReadLines(Console.In) : options.Do.Split(';'));
            bool hasEnded = headset.Stop();
            if (!hasEnded) report.Write("stop", false, "text", "a thread did not end within a second");
            return isDone && hasEnded ? 0 : 1;
        }
    }

    private static IEnumerable<string> ReadLines(TextReader input)
    {
        for (string line = input.ReadLine(); line != null; line = input.ReadLine()) yield return line;
    }
}

internal sealed class Options
{
    public string Address = "";
    public string Code = "";
    public string Identity = Path.Combine(Path.GetTempPath(), "iris-session-headless");
    public string Name = "headless";
    public string RoleName = Role.Operator;
    public string Trust = "";
    public bool IsJson;
    public string Do;

    public static Options Parse(string[] arguments)
    {
        if (arguments.Length == 0 || arguments[0] != "run") return null;
        Options options = new Options();
        for (int i = 1; i < arguments.Length; i++)
        {
            if (arguments[i] == "--json")
            {
                options.IsJson = true;
                continue;
            }
            if (i + 1 == arguments.Length) return null;
            string value = arguments[i + 1];
            switch (arguments[i++])
            {
                case "--address": options.Address = value; break;
                case "--code": options.Code = value; break;
                case "--identity": options.Identity = value; break;
                case "--name": options.Name = value; break;
                case "--role": options.RoleName = value; break;
                case "--trust": options.Trust = value; break;
                case "--do": options.Do = value; break;
                default: return null;
            }
        }
        return options;
    }
}
