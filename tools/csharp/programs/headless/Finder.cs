using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Transport;

/// <summary>Finds the gateway of a session: by an address or a link, or by beacons; pairs with it by a code.</summary>
internal static class Finder
{
    private const int BeaconMs = 10_000;
    private const int PairMs = 60_000;
    private const string Software = "iris-session headless";

    /// <summary>Return where the session is, null when it is nowhere or does not let us in.</summary>
    public static WebEndpoint[] Find(Options options, FileIdentityStore identity, Report report)
    {
        List<WebEndpoint> endpoints = new List<WebEndpoint>();
        foreach (string address in options.Address.Split(','))
        {
            string code = options.Code;
            WebEndpoint endpoint = address.Length == 0 ? FindByBeacon(report) : FindByAddress(address, report, ref code);
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

    private static WebEndpoint FindByBeacon(Report report)
    {
        BeaconListener listener = new BeaconListener();
        listener.Start();
        List<FoundSession> sessions = listener.ListSessions();
        for (long untilNs = MonotonicClock.NowNs + BeaconMs * 1_000_000L; sessions.Count == 0 && MonotonicClock.NowNs < untilNs; Thread.Sleep(50))
        {
            sessions = listener.ListSessions();
        }
        string problem = listener.Problem;
        listener.Stop();
        foreach (FoundSession session in sessions)
        {
            bool isPlain = HostName.IsLoopback(session.Beacon.Host) && session.Beacon.KeyFingerprint.Length == 0;
            report.Write("find", true, "session", session.Beacon.SessionName, "host", session.Beacon.Host, "web", session.Beacon.Web);
            if (session.Beacon.Web > 0) return new WebEndpoint(!isPlain, session.Beacon.Host, (int)session.Beacon.Web);
        }
        report.Write("find", false, "text", problem.Length > 0 ? problem : "no session is heard here");
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
