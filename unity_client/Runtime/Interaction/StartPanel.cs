// The panel before there is a session: what is happening, what is wrong and what to do, and buttons for what the wearer decides.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Core;
using IrisSession.Transport;

namespace IrisSession.Interaction
{
    /// <summary>What a wearer asks for at the panel.</summary>
    public enum StartAction
    {
        None,

        /// <summary>Join <see cref="StartPanel.Chosen"/>.</summary>
        Choose,

        /// <summary>Go to <see cref="StartPanel.Scanned"/>, a link that was seen.</summary>
        Enter,

        /// <summary>Leave what was given or entered, and look for sessions that announce themselves.</summary>
        Search,
        Trust,
        Retry,
        TypeAddress,
        TypeCode,

        /// <summary>Stop all robots of <see cref="StartPanel.Session"/>: the panel does it.</summary>
        Stop,
    }

    /// <summary>Decides what the panel says and which of its buttons is pressed. For the engine's thread; frames without news allocate nothing.</summary>
    public sealed class StartPanel : IPanels
    {
        /// <summary>Sessions that are listed; of more the address has to be typed.</summary>
        public const int MaxSessions = 6;
        private const int MaxButtons = MaxSessions + 3; // the e-stop, an invitation, an address
        private const double Press = 0.6;
        private const double LetGo = 0.4;

        /// <summary>Buttons answer this long after they appeared: a press that was meant for something before is none.</summary>
        private const long ReadNs = 500_000_000;

        /// <summary>What comes of a press is waited for so long at most.</summary>
        private const long AnswerNs = 2_000_000_000;

        /// <summary>A code that was seen longer ago is remembered by the runtime.</summary>
        private const long FreshNs = 1_000_000_000;

        // Before the eyes: distance [m], height of lines, distance of buttons, half their width, and what still hits one [m].
        private const double DistanceM = 1.0;
        private const double LineM = 0.026;
        private const double ApartM = 0.075;
        private const double HalfM = 0.2;
        private const double HitM = 0.034;

        private readonly Panel text = new Panel { LineM = LineM };
        private readonly Panel[] buttons = new Panel[MaxButtons];
        private readonly StartAction[] actions = new StartAction[MaxButtons];
        private readonly OfferedSession[] offered = new OfferedSession[MaxButtons];
        private readonly List<Panel> all = new List<Panel>();
        private readonly PanelRay[] rays = new PanelRay[2];
        private readonly BeforeEyes place = new BeforeEyes(DistanceM, 0);
        private readonly HandInput stops = new HandInput();
        private readonly bool[] isDown = { true, true };
        private readonly List<MarkerReport> reports = new List<MarkerReport>();
        private ConnectorView view = ConnectorView.Idle;
        private ConnectorView declined;
        private ConnectorView answered; // by a press at `answeredNs`: another one waits for what comes of it
        private long answeredNs;
        private PairingLink invitation; // of `seenText`, and not answered; null: none
        private string seenText = "";
        private ISessionPort session;
        private string notice = "";
        private bool isStopShown;
        private bool readsCodes;
        private bool isChanged = true;
        private bool areNew; // buttons
        private long sinceNs;
        private long seenNs;
        private int count;
        private StartAction action;

        public StartPanel()
        {
            all.Add(text);
            for (int i = 0; i < MaxButtons; i++) all.Add(buttons[i] = new Panel { LineM = LineM });
        }

        public IReadOnlyList<Panel> All { get { return all; } }

        public PanelRay[] Rays { get { return rays; } }

        /// <summary>Codes, in which the link of `iris-session pair` is looked for; null: none.</summary>
        public IMarkerSource Markers { get; set; }

        /// <summary>A session whose input has failed, which an e-stop of this headset reaches: the first button; null: none.</summary>
        public ISessionPort Session
        {
            get { return session; }
            set
            {
                isChanged |= session != value;
                session = value;
            }
        }

        /// <summary>Whether the newest e-stop of this headset has stopped robots: the same before, in and after a session.</summary>
        public StopReport Stop { get; } = new StopReport();

        /// <summary>Whether the device has a keyboard: else nothing can be typed.</summary>
        public bool CanType { get; set; }

        /// <summary>Words of the app that come first, empty for none.</summary>
        public string Notice
        {
            get { return notice; }
            set
            {
                isChanged |= notice != value;
                notice = value;
            }
        }

        /// <summary>The session of <see cref="StartAction.Choose"/>.</summary>
        public OfferedSession Chosen { get; private set; }

        /// <summary>The link of <see cref="StartAction.Enter"/>, empty before one.</summary>
        public string Scanned { get; private set; } = "";

        /// <summary>What the panel says.</summary>
        public string Text { get { return text.Text; } }

        /// <summary>Show what a connector does.</summary>
        public void Show(ConnectorView view)
        {
            isChanged |= view != this.view;
            this.view = view;
        }

        /// <summary>Take a frame.</summary>
        public void Update(HeadsetReading reading)
        {
            long nowNs = reading.CaptureNs;
            if (stops.TakeStops(reading)) Stop.Press(nowNs);
            Stop.Update(session, nowNs);
            isChanged |= isStopShown != Stop.IsUnconfirmed;
            isStopShown = Stop.IsUnconfirmed;
            isChanged |= readsCodes != ReadsCodes;
            readsCodes = ReadsCodes;
            if (isChanged) Fill(nowNs);
            place.Update(reading);
            text.At = place.At;
            for (int i = 0; i < MaxButtons; i++)
            {
                buttons[i].At = place.At - (i + 1) * ApartM * place.Up;
                buttons[i].Style = PanelStyle.Button;
            }
            for (int side = 0; side < 2; side++) Point(side, reading.Inputs[side], nowNs);
            ReadCodes(nowNs);
        }

        /// <summary>Return what the wearer asks for, once.</summary>
        public StartAction TakeAction()
        {
            StartAction taken = action;
            action = StartAction.None;
            return taken;
        }

        /// <summary>There is a session: codes are its sheets. The panel comes back before the eyes.</summary>
        public void Hide()
        {
            place.Hide();
            action = StartAction.None;
            invitation = null;
            isDown[0] = isDown[1] = true; // what is pressed now counts from its next press
        }

        private void Point(int side, InputReading hand, long nowNs)
        {
            rays[side] = default;
            bool wasDown = isDown[side];
            isDown[side] = !hand.IsTracked || (wasDown ? hand.Trigger > LetGo : hand.Trigger >= Press);
            if (!hand.IsTracked || !hand.HasRay) return;
            int best = -1;
            double distance = 2;
            for (int i = 0; i < count && place.IsPlaced; i++)
            {
                Double3 middle = buttons[i].At + 0.5 * LineM * place.Up;
                Pointing.MeasureSegment(hand.Ray, middle - HalfM * place.Left, middle + HalfM * place.Left, out double along, out double beside);
                if (beside > HitM || along <= 0 || (best >= 0 && along >= distance)) continue;
                best = i;
                distance = along;
            }
            rays[side] = new PanelRay { Ray = hand.Ray, LengthM = distance, IsHit = best >= 0 };
            if (best < 0) return;
            buttons[best].Style = PanelStyle.AimedButton;
            if (isDown[side] && !wasDown && nowNs - sinceNs >= ReadNs) Do(best, nowNs);
        }

        private void Do(int button, long nowNs)
        {
            if (actions[button] == StartAction.Stop)
            {
                Stop.Press(nowNs);
                session.EStop(StopInput.ByPanel);
                return;
            }
            if (IsAnswered(nowNs)) return;
            action = actions[button];
            Chosen = offered[button];
            isChanged = true;
            if (action == StartAction.None)
            {
                declined = view; // "No": nothing was sent, and nothing is
                return;
            }
            answered = view;
            answeredNs = nowNs;
            if (action == StartAction.Enter) Scanned = seenText;
            invitation = null;
        }

        private bool IsAnswered(long nowNs)
        {
            return view == answered && nowNs - answeredNs < AnswerNs;
        }

        private bool ReadsCodes { get { return Markers != null && (Markers.Support == MarkerSupport.Ready || Markers.Support == MarkerSupport.Starting); } }

        /// <summary>A link that is seen becomes a button: it may be that of another session, or of another person, whose code it would use up.</summary>
        private void ReadCodes(long nowNs)
        {
            if (Markers == null) return;
            bool isWanted = StartWords.MayScan(view);
            Markers.SetActive(isWanted);
            if (!isWanted || !readsCodes || IsAnswered(nowNs)) return;
            int read = Markers.Read(reports);
            for (int i = 0; i < read; i++)
            {
                MarkerReport report = reports[i];
                bool isSeen = report.IsTracked && (report.SeenNs < 0 || nowNs - report.SeenNs < FreshNs);
                if (!isSeen || string.IsNullOrEmpty(report.Text)) continue;
                bool isSame = report.Text == seenText;
                if (isSame) seenNs = nowNs;
                if (isSame ? invitation != null || view.Phase != ConnectorPhase.Failed : invitation != null && nowNs - seenNs < FreshNs) continue; // it is offered; another one is
                PairingLink link = FindInvitation(report.Text);
                if (link == null) continue;
                seenText = report.Text;
                seenNs = nowNs;
                invitation = link;
                isChanged = true;
            }
        }

        /// <summary>Return the link of a code that `iris-session pair` shows, null for every other code in the room.</summary>
        private static PairingLink FindInvitation(string text)
        {
            if (!text.StartsWith("iris://", StringComparison.OrdinalIgnoreCase) && !text.StartsWith("https://", StringComparison.OrdinalIgnoreCase)) return null;
            try
            {
                PairingLink link = PairingLink.Parse(text);
                return link.Code.Length > 0 ? link : null;
            }
            catch (LinkException)
            {
                return null;
            }
        }

        // --- words and buttons ------------------------------------------------------------------------------------------------------

        private void Fill(long nowNs)
        {
            isChanged = false;
            count = 0;
            StringBuilder lines = new StringBuilder();
            if (isStopShown) PanelWords.Wrap(lines, StopReport.Unconfirmed.ToString());
            if (notice.Length > 0) PanelWords.Wrap(lines, notice);
            if (session != null) Add("STOP all robots", StartAction.Stop);
            bool isDeclined = view == declined;
            foreach (string line in StartWords.Describe(view, isDeclined, readsCodes)) PanelWords.Wrap(lines, line);
            if (view.Phase == ConnectorPhase.Untrusted && !isDeclined)
            {
                lines.Append('\n').Append(StartWords.FormatFingerprint(view.Fingerprint));
                Add("Yes, this is the key", StartAction.Trust);
                Add("No", StartAction.None);
            }
            for (int i = 0; i < view.Sessions.Length && i < MaxSessions && view.Phase == ConnectorPhase.Choosing; i++) Add(StartWords.Describe(view.Sessions[i]), StartAction.Choose, view.Sessions[i]);
            bool isOver = view.Phase == ConnectorPhase.Failed || isDeclined;
            if (invitation != null && StartWords.MayScan(view)) Add(StartWords.Describe(invitation), StartAction.Enter);
            if (isOver) Add("Try again", StartAction.Retry);
            if (isOver || (view.Phase == ConnectorPhase.Searching && view.Endpoint.Length > 0)) Add("Look for sessions", StartAction.Search);
            if (CanType && isOver) Add("Type a join code", StartAction.TypeCode);
            if (CanType && view.Phase == ConnectorPhase.Untrusted && !isDeclined) Add("Type its join code", StartAction.TypeCode);
            if (CanType && (isOver || view.Phase == ConnectorPhase.Searching || view.Phase == ConnectorPhase.Choosing)) Add("Type an address", StartAction.TypeAddress);
            for (int i = count; i < MaxButtons; i++) buttons[i].Text = "";
            if (areNew) sinceNs = nowNs;
            areNew = false;
            text.Text = lines.ToString().TrimStart('\n');
            text.Style = isStopShown || notice.Length > 0 || isOver || view.Phase == ConnectorPhase.Untrusted ? PanelStyle.Urgent : PanelStyle.Status;
        }

        private void Add(string words, StartAction action, OfferedSession session = null)
        {
            areNew |= buttons[count].Text != words;
            buttons[count].Text = words;
            actions[count] = action;
            offered[count] = session;
            count++;
        }
    }
}
