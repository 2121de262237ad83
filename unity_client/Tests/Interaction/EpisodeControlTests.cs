using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    [TestFixture]
    public class EpisodeControlTests
    {
        private const long Second = 1_000_000_000;

        private static EpisodeChanged Make(string state, long untilNs = 0)
        {
            return new EpisodeChanged
            {
                Number = 4, State = state, Task = "pour", Instruction = "Pour the cup.", Wanted = 50, Successes = 3, UntilNs = untilNs,
            };
        }

        [Test]
        public void CountdownIsFeltOnceASecond()
        {
            EpisodeControl control = new EpisodeControl();
            EpisodeChanged countdown = Make(EpisodeState.Countdown, 3 * Second);
            int ticks = 0;
            for (long now = 0; now < 3 * Second; now += Second / 10)
            {
                control.Update(countdown, now);
                if (control.IsTick) ticks++;
                StringAssert.Contains("begins in " + control.SecondsLeft, control.Describe());
            }
            Assert.AreEqual(3, ticks);
            control.Update(countdown, 3 * Second);
            Assert.AreEqual(0, control.SecondsLeft);
        }

        [TestCase(EpisodeState.Idle, EpisodeAction.Start, null)]
        [TestCase(EpisodeState.Countdown, null, EpisodeAction.Discard)]
        [TestCase(EpisodeState.Running, EpisodeAction.Success, EpisodeAction.Discard)]
        [TestCase(EpisodeState.Confirm, EpisodeAction.Failure, EpisodeAction.Discard)]
        [TestCase(EpisodeState.Left, EpisodeAction.TakeOver, null)]
        [TestCase(EpisodeState.Closing, EpisodeAction.Success, EpisodeAction.Discard)]
        [TestCase(EpisodeState.Unknown, EpisodeAction.Start, null)]
        public void PressAsksForWhatTheStateAllows(string state, string lower, string upper)
        {
            EpisodeControl control = new EpisodeControl();
            control.Update(Make(state, Second), 0);
            Assert.AreEqual(lower, control.FindLower());
            Assert.AreEqual(upper, control.FindUpper());
            StringAssert.StartsWith("Pour the cup. Episode 4, 3 of 50: ", control.Describe());
        }

        [Test]
        public void OutcomeIsShownForAMomentWithoutATask()
        {
            EpisodeControl control = new EpisodeControl();
            control.Update(null, 0);
            Assert.AreEqual("", control.Describe());
            Assert.AreEqual(EpisodeAction.Start, control.FindLower());
            control.Update(new EpisodeChanged { Number = 1, State = EpisodeState.Running }, Second);
            Assert.AreEqual("Episode 1: is recorded", control.Describe());
            EpisodeChanged over = new EpisodeChanged { Number = 1, State = EpisodeState.Discarded };
            control.Update(over, 2 * Second);
            Assert.AreEqual("Episode 1: discarded", control.Describe());
            control.Update(over, 9 * Second);
            Assert.AreEqual("", control.Describe());
        }

        [Test]
        public void ButtonsOfControllersAreInTheSamplesAndAskForNothing()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            wearer[Side.Right].Buttons = ButtonBits.Lower;
            wearer.Run();
            Assert.AreEqual(ButtonBits.Lower, wearer.Session.Find(Device.ControllerRight).Buttons);
            Assert.IsEmpty(wearer.Session.Requests);
            wearer.Session.Episode = Make(EpisodeState.Countdown, FakePort.SessionOffset + 1000 * Second);
            wearer.Run(2);
            Assert.AreEqual(2, wearer.Haptics.Played.Count, "both hands, once");
            wearer.Input.PressEpisode(false);
            Assert.AreEqual(EpisodeAction.Discard, ((Episode)wearer.Session.Requests[0]).Action);
        }
    }
}
