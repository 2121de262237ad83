// Frames of WebSockets and heads of answers from bytes: split anywhere, hostile, and those of docs/protocol/web.json.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Core;
using IrisSession.Core.Tests;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class WebSocketReaderTests
    {
        private const int MaxBytes = 70_000;
        private static readonly byte[] Large = MakeBytes(66_000);

        private static byte[] MakeBytes(int count)
        {
            byte[] bytes = new byte[count];
            new Random(1).NextBytes(bytes);
            return bytes;
        }

        /// <summary>Return what a stream of bytes says, read in pieces.</summary>
        private static List<string> ReadAll(byte[] bytes, int firstPiece, int piece)
        {
            WebSocketReader reader = new WebSocketReader(MaxBytes);
            List<string> found = new List<string>();
            int begin = 0;
            while (begin < bytes.Length)
            {
                int end = Math.Min(bytes.Length, begin + (begin == 0 ? firstPiece : piece));
                int at = begin;
                while (at < end)
                {
                    WebSocketEvent came = reader.Read(bytes, ref at, end);
                    if (came == WebSocketEvent.NeedsMore) continue;
                    byte[] content = came == WebSocketEvent.Message ? reader.Message : reader.Control;
                    int count = came == WebSocketEvent.Message ? reader.MessageLength : reader.ControlLength;
                    string text = count > 100 ? count + " bytes from " + content[0] + " to " + content[count - 1] : Golden.ToHex(content, 0, count);
                    found.Add(came + " " + (came == WebSocketEvent.Close ? reader.CloseCode + " " + reader.CloseReason : text));
                }
                begin = end;
            }
            return found;
        }

        [Test]
        public void SplitAtEveryByteItSaysTheSame()
        {
            byte[] stream = Peer.Join(
                Peer.MakeFrame(0x82, new byte[] { 1, 2, 3 }),
                Peer.MakeFrame(0x89, new byte[] { 9 }),
                Peer.MakeFrame(0x02, new byte[] { 4, 5 }),
                Peer.MakeFrame(0x00, new byte[0]),
                Peer.MakeFrame(0x89, new byte[] { 8 }),
                Peer.MakeFrame(0x80, new byte[] { 6 }),
                Peer.MakeFrame(0x82, new byte[0]),
                Peer.MakeFrame(0x82, MakeBytes(300)),
                Peer.MakeFrame(0x8a, new byte[0]),
                Peer.MakeFrame(0x88, Peer.Join(new byte[] { 0x0f, 0xa8 }, Encoding.UTF8.GetBytes("slow"))));
            byte[] bytes = MakeBytes(300);
            List<string> expected = new List<string>
            {
                "Message 010203", "Ping 09", "Ping 08", "Message 040506", "Message ", "Message 300 bytes from " + bytes[0] + " to " + bytes[299], "Pong ", "Close 4008 slow",
            };
            for (int first = 1; first <= stream.Length; first++) CollectionAssert.AreEqual(expected, ReadAll(stream, first, stream.Length), "first " + first);
            for (int piece = 1; piece <= 16; piece++) CollectionAssert.AreEqual(expected, ReadAll(stream, piece, piece), "pieces of " + piece);
        }

        [Test]
        public void LongLengthsAreRead()
        {
            string expected = "Message 66000 bytes from " + Large[0] + " to " + Large[65_999];
            CollectionAssert.AreEqual(new[] { expected, expected }, ReadAll(Peer.Join(Peer.MakeFrame(0x82, Large), Peer.MakeFrame(0x82, Large)), 7, 1000));
        }

        [TestCase("c201 00", 1002, TestName = "reserved bit")]
        [TestCase("8281 05", 1002, TestName = "masked")]
        [TestCase("8100", 1003, TestName = "text")]
        [TestCase("8300", 1002, TestName = "unknown data frame")]
        [TestCase("8b00", 1002, TestName = "unknown control frame")]
        [TestCase("0900", 1002, TestName = "ping in fragments")]
        [TestCase("897e007e", 1002, TestName = "long ping")]
        [TestCase("8000", 1002, TestName = "continuation of nothing")]
        [TestCase("0200 8200", 1002, TestName = "message within a message")]
        [TestCase("8801 03", 1002, TestName = "close of one byte")]
        [TestCase("827f0000000000011171", 1009, TestName = "one byte too many")]
        [TestCase("827fffffffffffffffff", 1009, TestName = "length without a sign")]
        [TestCase("027f0000000000010000", 0, TestName = "not complete")]
        public void WhatBreaksTheRulesIsRefused(string hex, int code)
        {
            byte[] bytes = Golden.FromHex(hex.Replace(" ", ""));
            if (code == 0) CollectionAssert.IsEmpty(ReadAll(bytes, 1, 1));
            else Assert.AreEqual(code, Assert.Throws<TransportException>(() => ReadAll(bytes, 1, 1)).End.Code);
        }

        [Test]
        public void FragmentsTogetherAreBoundedToo()
        {
            byte[] stream = Peer.Join(Peer.MakeFrame(0x02, Large), Peer.MakeFrame(0x80, new byte[4001]));
            Assert.AreEqual(1009, Assert.Throws<TransportException>(() => ReadAll(stream, 1000, 1000)).End.Code);
        }

        [Test]
        public void HostileBytesAreRefusedOrRead()
        {
            int inputs = int.TryParse(Environment.GetEnvironmentVariable("IRIS_FUZZ"), out int wanted) ? wanted : 5_000;
            Random random = new Random(7);
            byte[] good = Peer.Join(
                Peer.MakeFrame(0x82, MakeBytes(200)), Peer.MakeFrame(0x02, MakeBytes(20)), Peer.MakeFrame(0x80, MakeBytes(130)), Peer.MakeFrame(0x88, new byte[] { 3, 0xe8 }));
            Multipart message = new Multipart();
            int refused = 0;
            for (int i = 0; i < inputs; i++)
            {
                byte[] bytes = (byte[])good.Clone();
                if (i % 4 == 0) random.NextBytes(bytes);
                for (int k = random.Next(1, 6); k > 0; k--) bytes[random.Next(bytes.Length)] = (byte)random.Next(256);
                WebSocketReader reader = new WebSocketReader(MaxBytes);
                try
                {
                    for (int at = 0; at < bytes.Length;)
                    {
                        if (reader.Read(bytes, ref at, bytes.Length) != WebSocketEvent.Message) continue;
                        message.Buffer = reader.Message;
                        if (WebMessage.Unpack(message, reader.MessageLength) >= 0) WebMessage.TryReadGateway(message, out string _, out string _);
                    }
                }
                catch (TransportException)
                {
                    refused++;
                }
                Assert.LessOrEqual(reader.Message.Length, MaxBytes);
            }
            Assert.Greater(refused, inputs / 10);
            Assert.Less(refused, inputs);
        }

        [Test]
        public void NothingIsAllocatedByALengthThatDoesNotCome()
        {
            WebSocketReader reader = new WebSocketReader(32_000_000);
            byte[] head = Golden.FromHex("827f0000000001e84800");
            int at = 0;
            Assert.AreEqual(WebSocketEvent.NeedsMore, reader.Read(head, ref at, head.Length));
            Assert.LessOrEqual(reader.Message.Length, 4096);
        }

        [Test]
        public void MessagesAreThoseOfTheVectors()
        {
            foreach (Json one in Golden.Load("web")["messages"].Items)
            {
                string name = (string)one["name"].Value;
                byte[] bytes = Golden.FromHex((string)one["hex"].Value);
                Multipart message = new Multipart { Buffer = bytes };
                Assert.AreEqual(one["channel"].Value, (long)WebMessage.Unpack(message, bytes.Length), name);
                List<Json> frames = one["frames"].Items;
                Assert.AreEqual(frames.Count, message.Count, name);
                for (int i = 0; i < frames.Count; i++) Assert.AreEqual(frames[i].Value, Golden.ToHex(bytes, message.OffsetOf(i), message.LengthOf(i)), name);
                if (frames.Count > 1) continue;
                byte[] frame = Golden.FromHex((string)frames[0].Value);
                WebSocketWriter writer = new WebSocketWriter();
                writer.AppendMessage((int)(long)one["channel"].Value, frame, frame.Length);
                Assert.AreEqual(one["hex"].Value, Golden.ToHex(Unmask(writer.Data, writer.Length), 0, bytes.Length), name);
            }
        }

        [Test]
        public void MasksDiffer()
        {
            WebSocketWriter writer = new WebSocketWriter();
            HashSet<string> masks = new HashSet<string>();
            for (int i = 0; i < 600; i++)
            {
                writer.Clear();
                writer.AppendMessage(1, new byte[1], 1);
                masks.Add(Golden.ToHex(writer.Data, 2, 4));
            }
            Assert.Greater(masks.Count, 590);
        }

        [Test]
        public void HeadsOfAnswersAreReadWhenTheyAreComplete()
        {
            byte[] bytes = Encoding.ASCII.GetBytes("HTTP/1.1 206 Partial Content\r\ncontent-length: 12\r\nContent-Range:bytes 0-11/40\r\n\r\nbody");
            int end = bytes.Length - 4;
            for (int count = 0; count < end; count++) Assert.IsNull(HttpHead.TryRead(bytes, count, out int _));
            HttpHead head = HttpHead.TryRead(bytes, bytes.Length, out int length);
            Assert.AreEqual(end, length);
            Assert.AreEqual(206, head.Status);
            Assert.AreEqual(12, head.ContentLength);
            Assert.AreEqual("bytes 0-11/40", head["content-range"]);
            Assert.AreEqual("", head["Other"]);
        }

        [TestCase("HTTP/2 200\r\n\r\n")]
        [TestCase("SSH-2.0-OpenSSH_9.2\r\n\r\n")]
        [TestCase("HTTP/1.1 abc OK\r\n\r\n")]
        [TestCase("HTTP/1.1 200 OK\r\nno header\r\n\r\n")]
        [TestCase("HTTP/1.1 200 OK\r\n: x\r\n\r\n")]
        public void WhatIsNoAnswerIsRefused(string text)
        {
            byte[] bytes = Encoding.ASCII.GetBytes(text);
            Assert.AreEqual(LinkFailure.NotAGateway, Assert.Throws<TransportException>(() => HttpHead.TryRead(bytes, bytes.Length, out int _)).End.Failure);
        }

        [TestCase("Content-Length: -1")]
        [TestCase("Content-Length: 99999999999999999999")]
        [TestCase("Content-Length: 5\r\nTransfer-Encoding: chunked")]
        [TestCase("Date: x")]
        public void LengthsThatAreNotStatedAreNone(string header)
        {
            byte[] bytes = Encoding.ASCII.GetBytes("HTTP/1.1 200 OK\r\n" + header + "\r\n\r\n");
            Assert.AreEqual(-1, HttpHead.TryRead(bytes, bytes.Length, out int _).ContentLength);
        }

        [Test]
        public void HeadsAreBounded()
        {
            byte[] bytes = new byte[HttpHead.MaxBytes];
            Assert.Throws<TransportException>(() => HttpHead.TryRead(bytes, bytes.Length, out int _));
        }

        private static byte[] Unmask(byte[] frame, int length)
        {
            int at = (frame[1] & 0x7f) == 126 ? 4 : 2;
            byte[] content = new byte[length - at - 4];
            for (int i = 0; i < content.Length; i++) content[i] = (byte)(frame[at + 4 + i] ^ frame[at + (i & 3)]);
            return content;
        }
    }
}
