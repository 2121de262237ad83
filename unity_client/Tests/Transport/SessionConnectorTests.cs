// From what an app was given to a session, over real sockets of this machine.
using System;
using System.Collections.Generic;
using System.IO;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class SessionConnectorTests
    {
        private const string Code = "7KQ2-M4XD-9PTR";
        private const string Nowhere = "nowhere.invalid";

        /// <summary>A session that lets in who has paired by its code.</summary>
        private sealed class Lab : IDisposable
        {
            public readonly FakeGateway Gateway;

            /// <summary>Refuses the next hello or pairing; null: none is refused.</summary>
            public volatile Refused Refusal;
            public volatile bool LetsIn;
            public int Pairings;
            public int Hellos;
            private readonly TestCertificate certificate;

            public Lab(TestCertificate certificate, bool letsIn = false)
            {
                this.certificate = certificate;
                LetsIn = letsIn;
                Gateway = new FakeGateway(peer => SessionClientTests.Serve(peer, null, null, "", Answer), certificate);
            }

            public string Address { get { return Gateway.MakeEndpoint().ToString(); } }

            public void Dispose()
            {
                Gateway.Dispose();
            }

            private ServerMessage Answer(ClientMessage message)
            {
                if (message is Hello) Interlocked.Increment(ref Hellos);
                if (message is Pair) Interlocked.Increment(ref Pairings);
                if (Refusal != null && (message is Hello || message is Pair)) return Refusal;
                if (message is Hello) return LetsIn ? null : new Refused { Code = RefusalCode.Unpaired };
                if (!(message is Pair pair)) return null;
                byte[] stretched = JoinCode.Stretch(Code, certificate.Hash);
                if (!JoinCode.IsSameProof(JoinCode.MakeClientProof(stretched, certificate.Hash, pair.Identity), pair.Proof)) return new Refused { Code = RefusalCode.Code };
                LetsIn = true;
                return new Paired { Proof = JoinCode.MakeServerProof(stretched, certificate.Hash, pair.Identity), Roles = new[] { Role.Operator } };
            }
        }

        /// <summary>An app, which may be started several times.</summary>
        private sealed class App : IDisposable
        {
            private readonly string folder = Path.Combine(Path.GetTempPath(), "iris-test-" + Guid.NewGuid().ToString("N"));
            private SessionConnector connector;

            public FileIdentityStore Identity { get { return new FileIdentityStore(folder); } }

            public SessionConnector Start(Action<ConnectorSettings> set)
            {
                Stop();
                ConnectorSettings settings = new ConnectorSettings
                {
                    Name = new string('a', 100), Devices = new[] { Device.Head }, Identity = Identity, Cache = new AssetCache(new SceneFetcherTests.MemoryFiles()), AgainMs = 10, SilenceNs = 0, BeaconPort = FindFreePort(),
                };
                set(settings);
                connector = new SessionConnector(settings);
                connector.Start();
                return connector;
            }

            public void WaitFor(ConnectorPhase phase)
            {
                WaitUntil(() => connector.View.Phase == phase, phase.ToString());
                Assert.AreEqual(phase == ConnectorPhase.Running, connector.Client != null);
                Assert.AreEqual(phase == ConnectorPhase.Running, connector.Scene != null);
                if (phase == ConnectorPhase.Failed) Assert.IsNotEmpty(connector.View.Phrase.What);
            }

            public void WaitUntil(Func<bool> condition, string what)
            {
                SessionClientTests.WaitUntil(() =>
                {
                    connector.Poll();
                    return condition();
                }, what);
            }

            public void Stop()
            {
                if (connector == null) return;
                Assert.IsTrue(connector.Stop());
                Assert.AreEqual(ConnectorPhase.Idle, connector.View.Phase);
                connector = null;
            }

            public void Dispose()
            {
                Stop();
                if (Directory.Exists(folder)) Directory.Delete(folder, true);
            }
        }

        private static int FindFreePort()
        {
            using (Socket free = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
            {
                free.Bind(new IPEndPoint(IPAddress.Loopback, 0));
                return ((IPEndPoint)free.LocalEndPoint).Port;
            }
        }

        private static string MakeFile(TestCertificate certificate, params string[] addresses)
        {
            return "{\"format\": 1, \"session\": \"lab\", \"addresses\": [\"" + string.Join("\", \"", addresses) + "\"], \"pin\": \"" + CertificateHash.ToKey(certificate.Hash)
                + "\", \"code\": \"" + Code + "\", \"expires\": 1.5}";
        }

        [Test]
        public void AKeyThatIsNotKnownIsShownAndNothingIsSentBeforeItIsTrusted()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First, true))
            {
                SessionConnector connector = app.Start(settings => settings.Address = lab.Address);
                app.WaitFor(ConnectorPhase.Untrusted);
                Assert.IsNotEmpty(connector.View.Fingerprint);
                StringAssert.Contains(connector.View.Fingerprint, connector.View.Phrase.What);
                Assert.AreEqual(0, lab.Hellos);
                connector.Trust();
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(lab.Address, connector.View.Endpoint);
                app.Start(settings => settings.Address = lab.Address); // the next day
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(2, lab.Hellos);
            }
        }

        [Test]
        public void ALinkWithACodePairsOnce()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First))
            {
                for (int day = 0; day < 2; day++)
                {
                    SessionConnector connector = app.Start(settings => settings.Address = lab.Address + "/#c=" + Code);
                    app.WaitFor(ConnectorPhase.Running);
                    Assert.AreEqual(day == 0, connector.View.Pairing != null);
                    Assert.AreEqual(1, lab.Pairings);
                }
                lab.LetsIn = false; // its owner took this headset off the list
                app.Start(settings => settings.Address = lab.Address + "/#c=" + Code);
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(2, lab.Pairings);
            }
        }

        [Test]
        public void APairingFilePairsOnceByTheFirstAddressThatAnswers()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First))
            {
                string file = MakeFile(TestCertificate.First, "https://" + Nowhere + ":1/", lab.Address + "/");
                for (int day = 0; day < 2; day++)
                {
                    SessionConnector connector = app.Start(settings => settings.PairingFile = file);
                    app.WaitFor(ConnectorPhase.Running);
                    Assert.AreEqual("lab", connector.View.Session);
                    Assert.AreEqual(1, lab.Pairings);
                }
            }
        }

        [Test]
        public void AFileWithAUsedCodeOrAnotherKeyFailsWithWhatToDo()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First) { Refusal = new Refused { Code = RefusalCode.Code } })
            {
                foreach (TestCertificate key in new[] { TestCertificate.First, TestCertificate.Second })
                {
                    SessionConnector connector = app.Start(settings => settings.PairingFile = MakeFile(key, lab.Address));
                    app.WaitFor(ConnectorPhase.Failed);
                    StringAssert.Contains("--unity", connector.View.Phrase.Remedy);
                }
                Assert.AreEqual(1, lab.Pairings);
                SessionConnector damaged = app.Start(settings => settings.PairingFile = "{");
                app.WaitFor(ConnectorPhase.Failed);
                lab.Refusal = null;
                damaged.Enter(lab.Address + "/#c=" + Code);
                app.WaitFor(ConnectorPhase.Running);
            }
        }

        [TestCase(RefusalCode.Unpaired)]
        [TestCase(RefusalCode.Version)]
        [TestCase(DenialReason.Role)]
        [TestCase(FaultCode.Revoked)]
        public void ARefusalFailsAndRetryGoesOnFromThere(string code)
        {
            using (App app = new App())
            using (Lab lab = new Lab(null, true) { Refusal = new Refused { Code = code } })
            {
                SessionConnector connector = app.Start(settings => settings.Address = lab.Address);
                app.WaitFor(ConnectorPhase.Failed);
                Assert.AreEqual(code, connector.View.Refusal.Code);
                Assert.IsNotEmpty(connector.View.Phrase.Remedy);
                lab.Refusal = null;
                connector.Retry();
                app.WaitFor(ConnectorPhase.Running);
            }
        }

        [Test]
        public void ACodeThatIsTypedPairsAlsoAfterAWrongOne()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First))
            {
                SessionConnector connector = app.Start(settings => settings.Address = lab.Address);
                app.WaitFor(ConnectorPhase.Untrusted);
                foreach (string wrong in new[] { "hello", "AAAA-AAAA-AAAA" })
                {
                    connector.EnterCode(wrong);
                    app.WaitUntil(() => connector.View.Phase == ConnectorPhase.Failed && connector.View.Pairing.Outcome == (wrong == "hello" ? PairingOutcome.NoCode : PairingOutcome.Refused), wrong);
                }
                connector.EnterCode(Code);
                app.WaitFor(ConnectorPhase.Running);
                CollectionAssert.AreEqual(TestCertificate.First.Hash, app.Identity.FindPin(lab.Gateway.MakeEndpoint().Authority));
            }
        }

        [Test]
        public void ALinkThatIsSeenOnceMoreJoinsByTheKnownKey()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First, true))
            {
                app.Identity.KeepPin(lab.Gateway.MakeEndpoint().Authority, TestCertificate.First.Hash);
                SessionConnector connector = app.Start(settings => { });
                connector.Enter(lab.Address + "/#c=AAAA-AAAA-AAAA"); // the session does not take it any more
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(1, lab.Pairings);
                connector.EnterCode("AAAA-AAAA-AAAA");
                app.WaitFor(ConnectorPhase.Failed);
                Assert.AreEqual(RefusalCode.Code, connector.View.Refusal.Code);
            }
        }

        [Test]
        public void AnotherKeyThanTheKnownOneIsRefusedAndACodeProvesIt()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.Second))
            {
                app.Identity.KeepPin(lab.Gateway.MakeEndpoint().Authority, TestCertificate.First.Hash);
                SessionConnector connector = app.Start(settings => settings.Address = lab.Address);
                app.WaitFor(ConnectorPhase.Failed);
                Assert.AreEqual(LinkFailure.WrongCertificate, connector.View.Problem.Failure);
                connector.Trust(); // nothing is shown to be trusted
                connector.Retry();
                app.WaitFor(ConnectorPhase.Failed);
                Assert.AreEqual(0, lab.Hellos);
                connector.EnterCode(Code);
                app.WaitFor(ConnectorPhase.Running);
            }
        }

        [Test]
        public void AKnownKeyIsKnownAtAnotherAddress()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First, true))
            {
                app.Identity.KeepPin("10.0.0.5:7725", TestCertificate.First.Hash);
                app.Start(settings => settings.Address = lab.Address);
                app.WaitFor(ConnectorPhase.Running);
            }
        }

        [Test]
        public void TheCableIsUsedWithTheKeyOfTheSessionAlone()
        {
            using (App app = new App())
            using (Lab lab = new Lab(TestCertificate.First))
            using (FakeGateway other = new FakeGateway(peer => throw new InvalidOperationException("another app of the headset was asked")))
            {
                SessionConnector connector = app.Start(settings =>
                {
                    settings.UsesCable = true;
                    settings.Address = "https://" + Nowhere + ":" + other.Port; // of which no key is known
                });
                app.WaitUntil(() => connector.View.Phrase.What.Length > 0, "it does not say that nothing answers");
                connector = app.Start(settings =>
                {
                    settings.UsesCable = true;
                    settings.PairingFile = MakeFile(TestCertificate.First, "https://" + Nowhere + ":" + lab.Gateway.Port);
                });
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(lab.Address, connector.View.Endpoint);
            }
        }

        [Test]
        public void ATypedAddressFindsTheGatewayByTheIntroduction()
        {
            TcpListener introductions = new TcpListener(IPAddress.Loopback, 0);
            introductions.Start();
            int control = ((IPEndPoint)introductions.LocalEndpoint).Port + 1;
            using (App app = new App())
            using (Lab lab = new Lab(null, true))
            {
                SessionConnector connector = app.Start(settings => settings.Address = "127.0.0.1:" + control);
                byte[] bytes = new Introduction { Beacon = MakeBeacon("lab", lab, control) }.Encode();
                using (Socket asked = introductions.AcceptSocket())
                {
                    asked.Send(Peer.Join(new byte[] { 0, 0, (byte)(bytes.Length >> 8), (byte)bytes.Length }, bytes));
                }
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual("http://127.0.0.1:" + lab.Gateway.Port, connector.View.Endpoint);
            }
            introductions.Stop();
        }

        private static Beacon MakeBeacon(string name, Lab lab, int control = 7721)
        {
            return new Beacon { Protocol = Wire.Version, SessionId = name, SessionName = name, Kind = "teleop", Host = "127.0.0.1", Control = control, Web = lab.Gateway.Port };
        }

        [Test]
        public void TheOnlySessionIsJoinedAndOfSeveralThePersonChooses()
        {
            using (App app = new App())
            using (Lab lab = new Lab(null, true))
            using (Lab gym = new Lab(null, true))
            using (Socket sender = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
            {
                int port = 0;
                SessionConnector Start(bool isHeadset = false)
                {
                    return app.Start(settings =>
                    {
                        port = settings.BeaconPort;
                        settings.UsesThisMachine = !isHeadset;
                    });
                }

                bool Announce(Lab one, string name)
                {
                    sender.SendTo(MakeBeacon(name, one).Encode(), new IPEndPoint(IPAddress.Loopback, port));
                    return true;
                }

                SessionConnector connector = Start();
                app.WaitUntil(() => connector.View.Phrase.What.Length > 0, "it does not say that nothing is heard");
                app.WaitUntil(() => Announce(lab, "lab") && connector.View.Phase == ConnectorPhase.Running, "it does not join");
                Assert.AreEqual("lab", connector.View.Session);

                connector = Start();
                app.WaitUntil(() => Announce(lab, "lab") && Announce(gym, "gym") && connector.View.Sessions.Length == 2, "it does not list them");
                Assert.AreEqual(ConnectorPhase.Choosing, connector.View.Phase);
                CollectionAssert.AreEqual(new[] { "gym", "lab" }, Array.ConvertAll(connector.View.Sessions, one => one.Name));
                connector.Choose(connector.View.Sessions[0]);
                app.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual("http://127.0.0.1:" + gym.Gateway.Port, connector.View.Endpoint);
                int hellos = lab.Hellos + gym.Hellos;

                connector = Start(isHeadset: true); // there, what announces itself at localhost is another app
                int announced = 0;
                app.WaitUntil(() => Announce(lab, "lab") && ++announced > 100 && connector.View.Phrase.What.Length > 0, "it does not say that nothing is heard");
                connector = Start(isHeadset: true);
                Beacon elsewhere = MakeBeacon("lab", lab); // the same app names another machine first
                elsewhere.Host = Nowhere;
                app.WaitUntil(
                    () =>
                    {
                        sender.SendTo(elsewhere.Encode(), new IPEndPoint(IPAddress.Loopback, port));
                        return Announce(lab, "lab") && (connector.View.Problem.Failure == LinkFailure.Unreachable || connector.Client != null);
                    },
                    "it does not try the other machine");
                app.Stop();
                Assert.AreEqual(hellos, lab.Hellos + gym.Hellos);
            }
        }

        [Test]
        public void ItStopsWhileAGatewayDoesNotAnswer()
        {
            TcpListener silent = new TcpListener(IPAddress.Loopback, 0);
            silent.Start();
            using (App app = new App())
            {
                foreach (string link in new[] { "", "/#c=" + Code })
                {
                    app.Start(settings => settings.Address = "https://localhost:" + ((IPEndPoint)silent.LocalEndpoint).Port + link);
                    using (Socket asked = silent.AcceptSocket()) app.Stop();
                }
                app.Start(settings => settings.Address = "nonsense/").Enter(Nowhere);
            }
            silent.Stop();
        }
    }
}
