// The other end of real sockets: a server on loopback whose connections are handled by a test, each on a thread of its own.
using System;
using System.Collections.Generic;
using System.IO;
using System.Net;
using System.Net.Security;
using System.Net.Sockets;
using System.Security.Authentication;
using System.Security.Cryptography;
using System.Security.Cryptography.X509Certificates;
using System.Text;
using System.Threading;

namespace IrisSession.Transport.Tests
{
    /// <summary>Accepts connections until it is disposed of, which closes them all.</summary>
    internal sealed class FakeGateway : IDisposable
    {
        private readonly TcpListener listener = new TcpListener(IPAddress.Loopback, 0);
        private readonly X509Certificate2 certificate;
        private readonly Action<Peer> handle;
        private readonly List<Socket> open = new List<Socket>();
        private bool isClosed;
        private volatile Exception failure;

        /// <param name="handle">Handles one connection; its end closes it.</param>
        /// <param name="certificate">For TLS, null for none.</param>
        public FakeGateway(Action<Peer> handle, TestCertificate certificate = null)
        {
            this.handle = handle;
            this.certificate = certificate?.Load();
            listener.Start();
            new Thread(Accept) { IsBackground = true, Name = "fake gateway" }.Start();
        }

        public int Port { get { return ((IPEndPoint)listener.LocalEndpoint).Port; } }

        /// <summary>Where it is, with the pin of a certificate.</summary>
        public WebEndpoint MakeEndpoint(TestCertificate pinned = null)
        {
            return new WebEndpoint(certificate != null, "localhost", Port, pinned?.Hash);
        }

        public void Dispose()
        {
            lock (open)
            {
                isClosed = true;
                foreach (Socket socket in open) socket.Close();
            }
            listener.Stop();
            if (failure != null) throw new InvalidOperationException("a connection of the fake gateway failed", failure);
        }

        private void Accept()
        {
            try
            {
                while (true)
                {
                    Socket socket = listener.AcceptSocket();
                    lock (open)
                    {
                        open.Add(socket);
                        if (isClosed) socket.Close();
                    }
                    new Thread(() => Serve(socket)) { IsBackground = true, Name = "fake gateway connection" }.Start();
                }
            }
            catch (Exception error) when (error is SocketException || error is ObjectDisposedException || error is InvalidOperationException)
            {
                // the test is over
            }
        }

        private void Serve(Socket socket)
        {
            try
            {
                using (socket)
                using (NetworkStream stream = new NetworkStream(socket))
                {
                    if (certificate == null)
                    {
                        handle(new Peer(stream));
                        return;
                    }
                    using (SslStream tls = new SslStream(stream))
                    {
                        tls.AuthenticateAsServer(certificate, false, SslProtocols.Tls12, false);
                        handle(new Peer(tls));
                    }
                }
            }
            catch (Exception error) when (HttpConnection.IsOfConnection(error))
            {
                // the client has gone, or refused the certificate
            }
            catch (Exception error)
            {
                failure = error; // of an assertion: the test fails when it disposes of this
            }
        }
    }

    /// <summary>One connection, as the server sees it.</summary>
    internal sealed class Peer
    {
        public readonly Stream Stream;
        private readonly byte[] buffer = new byte[16384];
        private int at;
        private int end;

        public Peer(Stream stream)
        {
            Stream = stream;
        }

        /// <summary>Return the lines of the head of a request.</summary>
        public string[] ReadRequest()
        {
            StringBuilder text = new StringBuilder();
            for (int length = 0; ;)
            {
                char one = (char)ReadByte();
                text.Append(one);
                if (one == '\n' && length == 0) break;
                if (one == '\n') length = 0;
                else if (one != '\r') length++;
            }
            return text.ToString().Split(new[] { "\r\n" }, StringSplitOptions.RemoveEmptyEntries);
        }

        /// <summary>Answer the request for a WebSocket. Returns its path.</summary>
        public string AcceptWebSocket(int piece = int.MaxValue, string[] request = null)
        {
            string path = "";
            string key = "";
            foreach (string line in request ?? ReadRequest())
            {
                if (line.StartsWith("GET ", StringComparison.Ordinal)) path = line.Split(' ')[1];
                if (line.StartsWith("Sec-WebSocket-Key: ", StringComparison.Ordinal)) key = line.Substring(19);
            }
            string accept;
            using (SHA1 sha = SHA1.Create()) accept = Convert.ToBase64String(sha.ComputeHash(Encoding.ASCII.GetBytes(key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11")));
            Send(Encoding.ASCII.GetBytes(
                "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: upgrade\r\nSec-WebSocket-Accept: " + accept
                + "\r\nSec-WebSocket-Protocol: iris-session.1\r\n\r\n"), piece);
            return path;
        }

        public void Send(byte[] bytes, int piece = int.MaxValue)
        {
            for (int at = 0; at < bytes.Length; at += Math.Min(piece, bytes.Length - at)) Stream.Write(bytes, at, Math.Min(piece, bytes.Length - at));
            Stream.Flush();
        }

        public void SendText(string text)
        {
            Send(Encoding.ASCII.GetBytes(text));
        }

        /// <summary>Return a frame of a server.</summary>
        public static byte[] MakeFrame(int first, byte[] payload)
        {
            int length = payload.Length;
            byte[] head = length < 126 ? new[] { (byte)first, (byte)length }
                : length < 65536 ? new byte[] { (byte)first, 126, (byte)(length >> 8), (byte)length }
                : new byte[] { (byte)first, 127, 0, 0, 0, 0, (byte)(length >> 24), (byte)(length >> 16), (byte)(length >> 8), (byte)length };
            return Join(head, payload);
        }

        /// <summary>Return a message of a channel, as the gateway sends it.</summary>
        public static byte[] MakeMessage(int channel, params byte[][] frames)
        {
            byte[] head = new byte[2 + 4 * frames.Length];
            head[0] = (byte)channel;
            head[1] = (byte)frames.Length;
            for (int i = 0; i < frames.Length; i++) BitConverter.GetBytes(frames[i].Length).CopyTo(head, 2 + 4 * i);
            return Join(head, Join(frames));
        }

        public static byte[] Join(params byte[][] parts)
        {
            List<byte> all = new List<byte>();
            foreach (byte[] part in parts) all.AddRange(part);
            return all.ToArray();
        }

        /// <summary>Return opcode and payload of the next frame of the client, which must be masked.</summary>
        public KeyValuePair<int, byte[]> ReadFrame()
        {
            int first = ReadByte();
            int second = ReadByte();
            if ((second & 0x80) == 0) throw new InvalidDataException("a frame of a client without a mask");
            long length = second & 0x7f;
            int more = length == 126 ? 2 : length == 127 ? 8 : 0;
            if (more > 0) length = 0;
            for (int i = 0; i < more; i++) length = length << 8 | (long)ReadByte();
            byte[] mask = { ReadByte(), ReadByte(), ReadByte(), ReadByte() };
            byte[] payload = new byte[length];
            for (int i = 0; i < length; i++) payload[i] = (byte)(ReadByte() ^ mask[i & 3]);
            return new KeyValuePair<int, byte[]>(first, payload);
        }

        /// <summary>Read until the client closes.</summary>
        public void ReadToEnd()
        {
            byte[] bytes = new byte[4096];
            while (Stream.Read(bytes, 0, bytes.Length) > 0)
            {
            }
        }

        private byte ReadByte()
        {
            if (at == end)
            {
                at = 0;
                end = Stream.Read(buffer, 0, buffer.Length);
                if (end == 0) throw new IOException("the client has closed");
            }
            return buffer[at++];
        }
    }
}
