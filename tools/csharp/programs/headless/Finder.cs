using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>Finds the gateway of a session: by an address or a link, or by beacons; pairs with it by a code.</summary>
internal static class Finder
{
    private const int BeaconMs = 10_000;
    private const int OthersMs = 600;
    private const int PairMs = 60_000;
    private const string Software = "iris-session headless";

    /// <summary>Return where the session is, null when it is nowhere or does not let us in.</summary>
    public static WebEndpoint[] Find(Options options, FileIdentityStore identity, Report report)
    {
        List<WebEndpoint> endpoints = new List<WebEndpoint>();
        foreach (string address in options.Address.Split(','))
        {
            string code = options.Code;
            WebEndpoint endpoint = address.Length == 0 ? FindByBeacon(options.Session, report) : FindByAddress(address, report, ref code);
            if (endpoint == null) return null;
            endpoint = identity.WithKnownPin(endpoint);
            if (code.Length > 0 && endpoint.IsSecure) endpoint = Pair(endpoint, code, options, identity, report);
            if (endpoint == null) return null;
            endpoints.Add(endpoint);
        }
        return endpoints.ToArray();
    }

    private static WebEndpoint FindByAddress(string address, Report report, ref string code)
    {
        PairingLink link;
        try
        {
            link = PairingLink.Parse(address);
        }
        catch (ClientException error)
        {
            report.Write("find", false, "text", error.Message);
            return null;
        }
        if (code.Length == 0) code = link.Code;
        GatewayFinder finder = new GatewayFinder(link);
        finder.Start();
        while (!finder.IsDone) Thread.Sleep(5);
        if (finder.Endpoint == null) report.Write("find", false, "text", finder.End.Text);
        return finder.Endpoint;
    }

    /// <summary>Listen for a moment, and return the only session that is heard, or the one with that name.</summary>
    private static WebEndpoint FindByBeacon(string name, Report report)
    {
        BeaconListener listener = new BeaconListener();
        listener.Start();
        List<FoundSession> sessions = new List<FoundSession>();
        long untilNs = MonotonicClock.NowNs + BeaconMs * 1_000_000L;
        bool isHeard = false;
        for (; MonotonicClock.NowNs < untilNs; Thread.Sleep(50))
        {
            sessions = listener.ListSessions();
            sessions.RemoveAll(one => one.Beacon.Web == 0 || (name.Length > 0 && one.Beacon.SessionName != name));
            if (isHeard || sessions.Count == 0) continue;
            isHeard = true; // others announce themselves five times a second
            untilNs = Math.Min(untilNs, MonotonicClock.NowNs + OthersMs * 1_000_000L);
        }
        string problem = listener.Problem;
        listener.Stop();
        if (sessions.Count == 1)
        {
            Beacon beacon = sessions[0].Beacon;
            report.Write("find", true, "session", beacon.SessionName, "host", beacon.Host, "web", beacon.Web);
            return new WebEndpoint(!HostName.IsLoopback(beacon.Host) || beacon.KeyFingerprint.Length > 0, beacon.Host, (int)beacon.Web);
        }
        string names = string.Join(", ", sessions.ConvertAll(one => one.Beacon.SessionName + " (" + one.Beacon.Host + ":" + one.Beacon.Web + ")"));
        string none = problem.Length > 0 ? problem : "no session is heard here: give its --address";
        report.Write("find", false, "text", sessions.Count == 0 ? none : "several sessions are heard, choose by --session or --address: " + names);
        return null;
    }

    private static WebEndpoint Pair(WebEndpoint endpoint, string code, Options options, FileIdentityStore identity, Report report)
    {
        PairingClient pairing = new PairingClient(endpoint, code, identity.KeyHash, options.Name, Software);
        pairing.Start();
        for (long untilNs = MonotonicClock.NowNs + PairMs * 1_000_000L; pairing.Result == null && MonotonicClock.NowNs < untilNs;) Thread.Sleep(10);
        pairing.Stop();
        PairingResult result = pairing.Result;
        bool isPaired = result.Outcome == PairingOutcome.Paired;
        string refusal = result.Refusal == null ? "" : result.Refusal.Code;
        report.Write(
            "pair", isPaired, "outcome", result.Outcome.ToString(), "code", refusal, "failure", result.End.Failure.ToString(), "text", result.Refusal == null ? result.End.Text ?? "" : result.Refusal.Message,
            "roles", result.Roles);
        if (!isPaired) return null;
        identity.KeepPin(result.Endpoint.Authority, result.Endpoint.Pin);
        return result.Endpoint;
    }
}
