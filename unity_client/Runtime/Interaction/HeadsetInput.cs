// A headset, frame by frame: readings in; samples, requests and looks out. All that it decides is in the other files of this folder.
// As web_client/src/xr/headset.ts.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

namespace IrisSession.Interaction
{
    /// <summary>Input of one headset. For the engine's thread; a frame allocates nothing after the first ones.</summary>
    public sealed class HeadsetInput
    {
        private const int Sides = 2;

        private struct PendingRequest
        {
            public long Ticket;
            public string Robot; // of an acquire
        }

        private readonly ISessionPort session;
        private readonly IBodies bodies;
        private readonly IHaptics haptics;
        private readonly HandContext context = new HandContext();
        private readonly List<HandIntent> intents = new List<HandIntent>();
        private readonly List<SampleInput> samples = new List<SampleInput>();
        private readonly List<PendingRequest> pending = new List<PendingRequest>();
        private readonly ConsentQuestions consents = new ConsentQuestions();
        private readonly FeedbackPulses pulses = new FeedbackPulses();
        private readonly double[] hits = new double[Sides];
        private IReadOnlyDictionary<string, RobotInfo> robotsOf;
        private long bodiesOf = -1;
        private int suspensions;
        private string sessionId = "";

        /// <param name="session">See <see cref="SessionClientPort"/>.</param>
        /// <param name="bodies">Bodies as they are shown.</param>
        /// <param name="haptics">Null: there are no motors.</param>
        public HeadsetInput(ISessionPort session, IBodies bodies, IHaptics haptics)
        {
            this.session = session;
            this.bodies = bodies;
            this.haptics = haptics;
        }

        /// <summary>Filled by the layer before <see cref="Update"/>.</summary>
        public readonly HeadsetReading Reading = new HeadsetReading();
        public readonly HandInput Hands = new HandInput();
        public readonly WristStop WristStop = new WristStop();
        public readonly ButtonPanel Buttons = new ButtonPanel();
        public readonly EpisodeControl Episode = new EpisodeControl();
        public readonly Pointing Pointing = new Pointing();
        public readonly WearerNews News = new WearerNews();

        /// <summary>Marks of a sheet that are touched: begun by itself where no codes are read, else by a trigger that is held.</summary>
        public readonly MarkTouching Touching = new MarkTouching();

        /// <summary>Whether the newest e-stop of this headset has stopped robots.</summary>
        public StopReport Stop { get; set; } = new StopReport();

        /// <summary>Codes; null: none are looked for.</summary>
        public MarkerLooks Markers { get; set; }

        /// <summary>In VR nothing of the room is seen, so a director may be aligned by its own word: at this `T_world_tracking`. Null: not now.</summary>
        public RigidTransform? OwnPlace { get; set; }

        /// <summary>The question that is shown, null for none.</summary>
        public ConsentQuestion Question { get; private set; }

        /// <summary>Whom one's own request waits for: the robot, empty for none.</summary>
        public string AwaitedRobot { get; private set; } = "";

        /// <summary>True while this participant holds a robot.</summary>
        public bool HoldsRobots { get { return context.Held.Count > 0; } }

        /// <summary>What a command of the application threw, for a log; null: nothing. Clear it once it is said.</summary>
        public Exception CommandError { get; set; }

        /// <summary>Return the robot that a hand points at, empty for none.</summary>
        public string FindPointed(Side side) { return context.Pointed[(int)side]; }

        /// <summary>Return the button that a hand points at.</summary>
        public Button FindAimed(Side side) { return context.Aimed[(int)side]; }

        /// <summary>Return how far the ray of a hand goes until it meets something [m], 0: it meets nothing.</summary>
        public double FindHit(Side side) { return hits[(int)side]; }

        /// <summary>Return whether a request for this robot has no answer yet.</summary>
        public bool IsRequested(string robot)
        {
            foreach (PendingRequest one in pending) if (one.Robot == robot) return true;
            return false;
        }

        /// <summary>Return the newest feedback of a robot, null for none.</summary>
        public Feedback FindFeedback(string robot) { return pulses.Find(robot); }

        /// <summary>Take a frame, before the scene is drawn.</summary>
        /// <param name="isLive">The person sees the scene, and their input reaches it.</param>
        /// <param name="suspensionCount">`HeadsetState.Suspensions`: when it has grown, buttons count from their next press.</param>
        public void Update(bool isLive, int suspensionCount)
        {
            long nowNs = Reading.CaptureNs;
            if (suspensionCount != suspensions || !isLive) Suspend();
            suspensions = suspensionCount;
            TakeStops(isLive);
            CheckSession();
            FillContext();
            Point();
            if (isLive)
            {
                intents.Clear();
                Touching.Update(Reading, context, session, haptics, IsTouchOffered);
                context.IsTouching = Touching.IsActive;
                Hands.Update(Reading, context, intents);
                foreach (HandIntent intent in intents) Do(intent, nowNs);
            }
            Episode.Update(session.Episode, session.HasClock ? session.ToSessionNs(nowNs) : 0);
            if (Episode.IsTick && isLive) PlayBoth(Pulse.Tick);
            Send(isLive);
            Markers?.Update(Reading, session);
        }

        /// <summary>Take what the session said, in order.</summary>
        public void Take(SessionNews news, long nowNs)
        {
            if (news.Kind == NewsKind.Reply) TakeReply(news.Ticket, news.Reply, nowNs);
            else if (news.Kind == NewsKind.Message) Take(news.Message.Message, nowNs);
            else if (news.Kind == NewsKind.Headset && news.Headset != HeadsetEvent.PermissionGranted) News.Set(news.Headset, nowNs);
            if (!string.IsNullOrEmpty(news.Text)) News.Set(news.Text, nowNs); // a notice, or why a request was not sent
        }

        /// <summary>Take a message of the session.</summary>
        public void Take(ServerMessage message, long nowNs)
        {
            CheckSession();
            Touching.Take(message, session);
            switch (message)
            {
                case Feedback feedback:
                    Pulse pulse = pulses.Take(feedback);
                    if (pulse.IsFelt && Hands.TryFindDriver(feedback.Robot, out Side side)) haptics?.Play(side, pulse);
                    break;
                case Reply reply when reply.Denial != null:
                    News.Set(reply.Denial, nowNs);
                    break;
                case Event one when one.Body is ConsentRequested asked && asked.Holder == session.ParticipantId:
                    consents.Add(asked, session.ConsentTimeoutNs, nowNs);
                    break;
                case Event one when one.Body is Notice notice && (notice.Participant.Length == 0 || notice.Participant == session.ParticipantId):
                    bool isSaid = Touching.IsActive && notice.Reason == DenialReason.AlignmentRefused; // by `Touching`
                    if (!isSaid) News.Set(notice.Text, nowNs);
                    break;
                case Event one when one.Body is LeaseChanged changed && changed.Cause != "queue":
                    consents.Remove(changed.Lease.Target);
                    break;
            }
        }

        /// <summary>Take the answer to a request of ours; null: the connection was lost before it came. Others are ignored.</summary>
        public void TakeReply(long ticket, Reply reply, long nowNs)
        {
            for (int i = 0; i < pending.Count; i++)
            {
                if (pending[i].Ticket != ticket) continue;
                PendingRequest one = pending[i];
                pending.RemoveAt(i);
                bool isGranted = reply != null && reply.Ok;
                if (one.Robot != null) Hands.Settle(one.Robot, isGranted, nowNs);
                if (reply != null && reply.Denial != null) News.Set(reply.Denial, nowNs);
                return;
            }
        }

        /// <summary>Do what the lower, or the upper, button of a controller does: for devices without buttons.</summary>
        public void PressEpisode(bool isLower)
        {
            string action = isLower ? Episode.FindLower() : Episode.FindUpper();
            if (action != null) session.Request(new Episode { Action = action });
        }

        /// <summary>Stop all robots.</summary>
        public void StopAll(string reason)
        {
            Stop.Press(Reading.CaptureNs);
            session.EStop(reason);
        }

        /// <summary>The wearer recentred, or the runtime located itself anew.</summary>
        public void OnRecentred()
        {
            session.ReportRecentred();
            Markers?.Reset();
            Touching.Reset();
            foreach (InputReading input in Reading.Inputs) input.HasPose = false;
            Suspend();
        }

        /// <summary>In another session, what the last one said is void.</summary>
        private void CheckSession()
        {
            if (session.SessionId == sessionId) return;
            sessionId = session.SessionId;
            pulses.Clear();
            consents.Clear();
            Touching.Reset();
        }

        /// <summary>The room is seen, and nothing reads its codes.</summary>
        private bool IsTouchOffered
        {
            get { return !OwnPlace.HasValue && (Markers == null || Markers.Support == MarkerSupport.Missing || Markers.Support == MarkerSupport.NotAllowed); }
        }

        private void Suspend()
        {
            Hands.Suspend();
            WristStop.Suspend();
            Touching.Suspend();
        }

        /// <summary>A button of the e-stop counts whenever the runtime reports it: also without tracking, and in the frame of a recentring.</summary>
        private void TakeStops(bool isLive)
        {
            if (Hands.TakeStops(Reading)) StopAll(StopInput.ByButton);
            if (isLive && WristStop.Update(Reading)) StopAll(StopInput.ByWrist);
            Stop.Update(session, Reading.CaptureNs);
        }

        private void FillContext()
        {
            context.Clear();
            IReadOnlyDictionary<string, RobotInfo> robots = session.Robots;
            if (!ReferenceEquals(robots, robotsOf) || bodies.Version != bodiesOf)
            {
                Pointing.SetRobots(robots.Values, bodies);
                robotsOf = robots;
                bodiesOf = bodies.Version;
            }
            foreach (string robot in Pointing.Robots)
            {
                Feedback feedback = pulses.Find(robot);
                if (feedback != null && feedback.HoldReason.Length == 0) context.Following.Add(robot);
                if (feedback != null && feedback.HoldReason == HoldReason.Emulated) context.Guessed.Add(robot);
                if (!session.Leases.TryGetValue(robot, out Lease lease) || !SessionMirror.IsHeldBy(lease, session.ParticipantId)) continue;
                context.Held.Add(robot);
                if (lease.SubHolders.Length == 0) context.Tenures[robot] = new Tenure(lease.LeaseVersion, session.SceneEpoch);
            }
            context.CanPlace = OwnPlace.HasValue && session.IsJoined && session.AlignmentState == AlignmentState.None && IsDirector();
        }

        private bool IsDirector()
        {
            return session.Participants.TryGetValue(session.ParticipantId, out ParticipantInfo self) && self.Role == Role.Director;
        }

        /// <summary>Find the buttons and robots that hands point at.</summary>
        private void Point()
        {
            UpdateQuestion();
            Buttons.Update(Reading, Question == null ? -1 : Question.ConsentId, AwaitedRobot.Length > 0);
            bool isPlaced = session.TryGetAlignment(out RigidTransform T_world_tracking);
            if (!isPlaced && OwnPlace.HasValue)
            {
                T_world_tracking = OwnPlace.Value;
                isPlaced = true;
            }
            for (int side = 0; side < Sides; side++)
            {
                hits[side] = 0;
                InputReading input = Reading.Inputs[side];
                if (!input.IsTracked || !input.HasRay || Hands.IsSqueezing((Side)side)) continue;
                Button button = Buttons.FindAimed(input.Ray, out double distance);
                if (button.IsSomething)
                {
                    context.Aimed[side] = button;
                    Buttons.MarkAimed(button);
                    hits[side] = distance;
                    continue;
                }
                if (!isPlaced || Touching.IsActive) continue;
                string robot = Pointing.FindPointed(input.Ray.In(T_world_tracking), bodies, out distance);
                context.Pointed[side] = robot;
                if (robot.Length > 0) hits[side] = distance;
            }
        }

        private void UpdateQuestion()
        {
            Question = consents.Find(Reading.CaptureNs);
            AwaitedRobot = "";
            foreach (PendingRequest one in pending)
            {
                if (one.Robot == null || !session.Leases.TryGetValue(one.Robot, out Lease lease) || lease.Mode != LeaseMode.Request || lease.Holder.Length == 0) continue;
                AwaitedRobot = one.Robot;
                break;
            }
        }

        private void Do(HandIntent intent, long nowNs)
        {
            switch (intent.Kind)
            {
                case IntentKind.Acquire:
                    long ticket = session.Request(new Acquire { Robots = new[] { intent.Robot } });
                    if (ticket == 0) Hands.Settle(intent.Robot, false, nowNs);
                    else pending.Add(new PendingRequest { Ticket = ticket, Robot = intent.Robot });
                    break;
                case IntentKind.Release:
                    if (!session.Leases.TryGetValue(intent.Robot, out Lease lease)) break;
                    session.Request(new Release { Targets = new[] { new Target { Name = intent.Robot, LeaseVersion = lease.LeaseVersion } } });
                    break;
                case IntentKind.Press:
                    Press(intent.Button);
                    break;
                case IntentKind.Place:
                    if (!OwnPlace.HasValue) break;
                    PlaceAlignment place = new PlaceAlignment { Participant = session.ParticipantId };
                    SampleBuilder.WritePose(OwnPlace.Value, place.T_world_tracking);
                    session.Request(place);
                    break;
            }
        }

        private void Press(Button button)
        {
            if (button.Id == Button.Grant || button.Id == Button.Refuse)
            {
                if (Question == null) return;
                session.Request(new Consent { ConsentId = Question.ConsentId, Grant = button.Id == Button.Grant });
                consents.Remove(Question);
                return;
            }
            try
            {
                Buttons.FindCommand(button)?.Run();
            }
            catch (Exception error)
            {
                CommandError = error; // of the application: samples and the e-stop go on
            }
        }

        private void Send(bool isLive)
        {
            if (!session.IsJoined || !session.HasClock) return;
            samples.Clear();
            Hands.MakeInputs(Reading, isLive, session.ToSessionNs(Reading.CaptureNs), samples);
            foreach (SampleInput input in samples) session.TrySendSample(input);
        }

        private void PlayBoth(Pulse pulse)
        {
            haptics?.Play(Side.Left, pulse);
            haptics?.Play(Side.Right, pulse);
        }
    }
}
