using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    [TestFixture]
    public class EpisodeControlTests
    {
        private const long Second = 1_000_000_000;

        [Test]
        public void EpisodeBeginsAfterACountdownThatIsFelt()
        {
            EpisodeControl control = new EpisodeControl();
            Assert.IsNull(control.Update(null, true, 0));
            Assert.IsNull(control.PressLower(0));
            int ticks = 0;
            for (long now = 0; now < 3 * Second; now += Second / 10)
            {
                Assert.IsNull(control.Update(null, true, now));
                if (control.IsTick) ticks++;
                Assert.AreEqual(EpisodeStep.Countdown, control.Step);
            }
            Assert.AreEqual(3, ticks);
            Assert.AreEqual(EpisodeAction.Start, control.Update(null, true, 3 * Second));
            Assert.IsNull(control.Update(null, true, 3 * Second + 1), "once");
            Assert.IsNull(control.PressLower(3 * Second + 2), "the answer is waited for");
            Assert.AreEqual(EpisodeStep.Idle, control.Step);
        }

        [TestCase(true)]
        [TestCase(false)]
        public void AnyPressCancelsTheCountdown(bool isLower)
        {
            EpisodeControl control = new EpisodeControl();
            control.Update(null, true, 0);
            control.PressLower(0);
            control.Update(null, true, Second);
            Assert.IsNull(isLower ? control.PressLower(Second) : control.PressUpper(Second));
            Assert.IsNull(control.Update(null, true, 4 * Second));
            Assert.AreEqual(EpisodeStep.Idle, control.Step);
        }

        [Test]
        public void HeadsetThatIsTakenOffBeginsNothing()
        {
            EpisodeControl control = new EpisodeControl();
            control.Update(null, true, 0);
            control.PressLower(0);
            Assert.IsNull(control.Update(null, false, 3 * Second));
            Assert.IsNull(control.Update(null, true, 4 * Second));
            control.PressLower(5 * Second);
            control.Update(null, true, 5 * Second);
            control.Cancel();
            Assert.IsNull(control.Update(null, true, 9 * Second));
        }

        [Test]
        public void EpisodeEndsByTheSameButtonTwice()
        {
            EpisodeControl control = new EpisodeControl();
            EpisodeChanged running = new EpisodeChanged { Number = 4, State = "running" };
            control.Update(running, true, 0);
            Assert.AreEqual(4, control.Number);
            Assert.IsNull(control.PressLower(0));
            Assert.AreEqual(EpisodeStep.AskSuccess, control.Step);
            control.Update(running, true, 5 * Second);
            Assert.AreEqual(EpisodeStep.Running, control.Step, "no answer");
            Assert.IsNull(control.PressLower(5 * Second));
            Assert.IsNull(control.PressUpper(5 * Second), "another button takes it back");
            Assert.IsNull(control.PressUpper(5 * Second));
            control.Update(running, true, 6 * Second);
            Assert.AreEqual(EpisodeAction.Discard, control.PressUpper(6 * Second));
            control.Update(new EpisodeChanged { Number = 4, State = "discarded" }, true, 7 * Second);
            Assert.AreEqual(EpisodeStep.Idle, control.Step);
            Assert.AreEqual(5, control.Number);
            StringAssert.Contains("4", control.Describe(7 * Second));
            Assert.AreEqual("", control.Describe(20 * Second));
            control.PressLower(8 * Second);
            control.Update(running, true, 8 * Second + 1);
            Assert.AreEqual(EpisodeStep.Running, control.Step, "another participant began one meanwhile");
            control.PressLower(9 * Second);
            Assert.AreEqual(EpisodeAction.Success, control.PressLower(9 * Second));
        }

        [Test]
        public void WearerBeginsAndEndsAnEpisodeByTheButtonsOfAController()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            wearer.PressButton(Side.Right, ButtonBits.Lower);
            wearer.RunFor(EpisodeControl.CountdownNs);
            Assert.AreEqual(EpisodeAction.Start, ((Episode)wearer.Session.Requests[0]).Action);
            Assert.AreEqual(6, wearer.Haptics.Played.Count, "three seconds, both hands");
            wearer.Session.Episode = new EpisodeChanged { Number = 1, State = "running" };
            wearer.Input.TakeReply(1, new Reply { Ok = true }, 0);
            wearer.Run();
            wearer.PressButton(Side.Right, ButtonBits.Lower);
            wearer.PressButton(Side.Right, ButtonBits.Lower);
            Assert.AreEqual(EpisodeAction.Success, ((Episode)wearer.Session.Requests[1]).Action);
        }
    }
}
