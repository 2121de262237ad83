using System;
using System.Linq;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class LinkWordsTests
    {
        [Test]
        public void EveryEndSaysWhatIsWrongAndWhatToDo()
        {
            foreach (LinkFailure failure in Enum.GetValues(typeof(LinkFailure)))
            {
                Phrase phrase = LinkWords.OfEnd(new LinkEnd(failure, 0, ""));
                Assert.AreEqual(failure == LinkFailure.None, phrase.What.Length == 0, failure.ToString());
                Assert.AreEqual(failure == LinkFailure.None, phrase.Remedy.Length == 0, failure.ToString());
            }
            int[] codes = { CloseCode.SessionEnded, CloseCode.Version, CloseCode.NotAllowed, CloseCode.TooSlow, CloseCode.Flood, CloseCode.Restart, 1006 };
            Assert.AreEqual(codes.Length, codes.Select(code => LinkWords.OfEnd(new LinkEnd(LinkFailure.Closed, code, "")).What).Distinct().Count());
        }

        [Test]
        public void TextsOfOthersStayOnOneShortLine()
        {
            string what = LinkWords.OfEnd(new LinkEnd(LinkFailure.NotAGateway, 0, "lab\n" + new string('x', 5000))).What;
            Assert.Less(what.Length, 200);
            Assert.AreEqual(-1, what.IndexOf('\n'));
            Assert.IsTrue(LinkWords.OfEnd(new LinkEnd(LinkFailure.UnknownCertificate, 0, "", new byte[32], "3F:A2")).What.Contains("3F:A2"));
        }

        [Test]
        public void EveryPairingHasWords()
        {
            foreach (PairingOutcome outcome in Enum.GetValues(typeof(PairingOutcome)))
            {
                PairingResult result = new PairingResult(outcome, refusal: new Refused { Code = RefusalCode.Code }, end: new LinkEnd(LinkFailure.Unreachable, 0, ""));
                Phrase phrase = LinkWords.OfPairing(result);
                Assert.IsNotEmpty(phrase.What, outcome.ToString());
                bool needsNothing = outcome == PairingOutcome.Paired || outcome == PairingOutcome.Stopped;
                Assert.AreEqual(needsNothing, phrase.Remedy.Length == 0, outcome.ToString());
            }
        }
    }
}
