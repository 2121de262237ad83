// A client without engine and screen: joins a session over the web wire as a headset app does, and does what it is asked to.
//
// Exit status: 0 when all commands succeeded, 1 when one failed, 2 when no session could be joined, 130 after Ctrl-C.
using System;
using System.Collections.Generic;
using System.IO;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

internal static class Program
{
    private const int NotJoinedStatus = 2;
    private const int InterruptedStatus = 130;

    private const string Usage = @"usage: headless run [options]

Join a session as a headset app does, and do what is asked: commands of --do, else lines of the input.

  --address ADDRESS   host:port of the web channel, https://..., or a link of `iris-session pair --web`; several with commas, the
                      preferred one first (default: a session that announces itself)
  --zmq HOST:PORT     control channel of a session: by ZeroMQ, without a gateway; without certificates only on this machine
  --curve-server FILE certificate *.key of the session, with --zmq
  --curve-key FILE    our own, *.key_secret
  --session NAME      which of the sessions that announce themselves
  --pairing-file FILE file of `iris-session pair --unity`
  --code CODE         join code of `iris-session pair`
  --trust FINGERPRINT certificate to trust without a code, as `join` prints it
  --identity FOLDER   secret, resume token and known certificates (default: in the folder for temporary files)
  --name NAME         name that others see (headless)
  --role ROLE         operator, observer, ... (operator)
  --json              a line of JSON for each command
  --do COMMANDS       commands, separated by semicolons

Ctrl-C leaves the session; on Mono only in a terminal: a signal from elsewhere ends the program without a goodbye.

Commands: join; scene; draw; align; marks; acquire ROBOT; move ROBOT X Y Z (metres in the world); touch ROBOT X Y Z;
release ROBOT; episode ACTION; measure SECONDS; follow COUNT FILE; media STREAM COUNT FILE; visual ID; body NAME; view;
until EVENT; wait SECONDS; estop; quit

Example: headless run --code 7B60-VY33-DJ6M --do ""join; align; acquire left; move left 0 0 0.1""";

    private static int Main(string[] arguments)
    {
        if (Array.IndexOf(arguments, "--help") >= 0 || Array.IndexOf(arguments, "-h") >= 0)
        {
            Console.Out.WriteLine(Usage);
            return 0;
        }
        Options options = Options.Parse(arguments, out string problem);
        if (options == null)
        {
            Console.Error.WriteLine("headless: " + problem + "; see headless --help");
            return NotJoinedStatus;
        }
        Report report = new Report(options.IsJson);
        using (Headset headset = new Headset(options, report))
        {
            Console.CancelKeyPress += (sender, pressed) =>
            {
                pressed.Cancel = !headset.IsInterrupted; // a second Ctrl-C ends at once
                headset.IsInterrupted = true;
            };
            Commands commands = new Commands(headset, report);
            bool isDone = commands.Run(options.Do == null ? ReadLines(Console.In) : options.Do.Split(';'));
            bool hasEnded = headset.Stop();
            if (!hasEnded) report.Write("stop", false, "text", "a thread did not end in time");
            if (headset.IsInterrupted) return InterruptedStatus;
            if (headset.IsHopeless || commands.IsRefused) return NotJoinedStatus;
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
    public string Zmq = "";
    public string CurveServer = "";
    public string CurveKey = "";
    public string Session = "";
    public string PairingFile;
    public string Code = "";
    public string Identity = Path.Combine(Path.GetTempPath(), "iris-session-headless");
    public string Name = "headless";
    public string RoleName = Role.Operator;
    public string Trust = "";
    public bool IsJson;
    public string Do;

    public static Options Parse(string[] arguments, out string problem)
    {
        problem = "the command is `run`";
        if (arguments.Length == 0 || arguments[0] != "run") return null;
        Options options = new Options();
        for (int i = 1; i < arguments.Length; i++)
        {
            if (arguments[i] == "--json")
            {
                options.IsJson = true;
                continue;
            }
            problem = "\"" + arguments[i] + "\" is no option, or has no value";
            if (i + 1 == arguments.Length) return null;
            string value = arguments[i + 1];
            switch (arguments[i++])
            {
                case "--address": options.Address = value; break;
                case "--zmq": options.Zmq = value; break;
                case "--curve-server": options.CurveServer = value; break;
                case "--curve-key": options.CurveKey = value; break;
                case "--session": options.Session = value; break;
                case "--pairing-file":
                    problem = "the file " + value + " cannot be read";
                    if (!File.Exists(value)) return null;
                    options.PairingFile = File.ReadAllText(value);
                    break;
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
